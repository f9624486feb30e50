"""Transfer of arrays and PyTorch's CUDA tensors to and from the simulator; tensors stay on the device.

Taichi and PyTorch share the CUDA context and the default stream, so kernels can access the memory of a tensor
directly.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from plab.errors import ArgumentError
from plab.plugins import torch
from plab.sim.compiler import address_of, ti
from plab.sim.runtime import copy_memory

# Kernel arguments: Taichi or NumPy arrays or CUDA tensors, of numbers or of vectors.
if TYPE_CHECKING:
    from typing_extensions import TypeIs

    Array = Any
else:
    Array = ti.types.ndarray(ndim=1)


NUMPY_TYPES = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32}
"""NumPy's types of the numbers in arrays and fields."""


def on_device(array: object) -> "TypeIs[torch.Tensor]":
    """Return True if the value is a CUDA tensor, without importing PyTorch."""
    return bool(getattr(array, "is_cuda", False))


class Constants:
    """Constants that are combined with arrays and CUDA tensors in every step, copied to the device once."""

    def __init__(self, values: ArrayLike) -> None:
        """Store numbers of any shape."""
        self._values = np.asarray(values, np.float64)
        self._tensor: torch.Tensor | None = None

    def like(self, array: Any) -> Any:
        """Return the numbers as an array, or as a tensor of the type and on the device of a CUDA tensor."""
        if not on_device(array):
            return self._values
        if self._tensor is None or (self._tensor.dtype, self._tensor.device) != (array.dtype, array.device):
            self._tensor = array.new_tensor(self._values)
        return self._tensor


@ti.kernel
def _copy_numbers(array: Array, first: ti.i32, numbers: Array, count: ti.i32, writes: ti.i32):
    for i in range(count):
        if writes != 0:
            array[first + i] = numbers[i]
        else:
            numbers[i] = array[first + i]


def copy_numbers(array: ti.Ndarray, first: int, numbers: Any, count: int, writes: bool) -> None:
    """Copy numbers to or from a device array, starting at its entry ``first``.

    NumPy arrays of the same type are copied as memory, because kernels take time to load and to launch. All
    other arrays share one kernel.
    """
    if isinstance(numbers, np.ndarray):
        assert numbers.flags.c_contiguous and numbers.dtype == NUMPY_TYPES[array.dtype]
        copy_memory(address_of(array) + first * numbers.itemsize, numbers[:count], writes)
    else:
        _copy_numbers(array, first, numbers, count, writes)


def from_host(array: ti.Ndarray, numbers: np.ndarray) -> None:
    """Copy an array of the same type and number of entries to a device array of numbers or vectors."""
    copy_numbers(array, 0, numbers.reshape(-1), numbers.size, True)


def to_host(array: ti.Ndarray) -> np.ndarray:
    """Return a device array of numbers or vectors."""
    out = np.empty((*array.shape, *array.element_shape), NUMPY_TYPES[array.dtype])
    copy_numbers(array, 0, out.reshape(-1), out.size, False)
    return out


def flat(array: Any) -> Any:
    """Return the numbers of an array, or of a CUDA tensor without its graph, as a contiguous vector."""
    if on_device(array):
        return array.detach().reshape(-1).contiguous()
    return np.ascontiguousarray(array).reshape(-1)


def output_for(fill: Callable[[Any], None], count: int, double: bool, like: "torch.Tensor") -> "torch.Tensor":
    """Return a new tensor of ``count`` numbers with the device and type of a CUDA tensor, filled by the
    kernel that ``fill`` launches, in float64 if ``double``."""
    out = like.new_empty(count, dtype=torch.float64 if double else torch.float32)
    if count:
        fill_tensor(out, fill)
    return out.to(like.dtype)


def fill_tensor(out: "torch.Tensor", fill: Callable[[Any], None]) -> None:
    """Fill a new CUDA tensor by the kernel that ``fill`` launches, in any PyTorch stream."""
    if _in_default_stream():
        fill(out)
    else:
        # Pending work of the stream may read memory that the new tensor reuses.
        torch.cuda.current_stream().synchronize()
        fill(out)
        ti.sync()


def numbers_of(
    array: ti.Ndarray, shape: tuple[int, ...], like: object, first: int = 0
) -> "np.ndarray | torch.Tensor":
    """Copy entries of a device array, starting at ``first``, to an array of the given shape, or to a tensor
    like the CUDA tensor ``like``."""
    count = int(np.prod(shape))
    if on_device(like):
        filled = output_for(lambda out: copy_numbers(array, first, out, count, False), count, True, like)
        return filled.reshape(shape)
    out = np.zeros(shape)
    if count:
        copy_numbers(array, first, out.reshape(-1), count, False)
    return out


def kernel_actions(
    actions: "np.ndarray | torch.Tensor",
    engine: Any,
    components: int,
    through: Callable[[Any], Any] | None = None,
    *,
    rollout: bool = False,
) -> "np.ndarray | torch.Tensor | ti.Ndarray":
    """Return actions for the kernels, flat and in float64.

    Args:
        actions: Actions of one environment step, shape [batch, component], which stay where they are; or of a
            rollout, shape [batch, T, component], which become a Taichi array ordered by step.
        engine: The kernels.
        components: Number of components.
        through: Function that converts checked actions, shape [T, batch, component], to actions of the
            manipulators.
        rollout: Whether the actions are those of a rollout.

    Raises:
        ValueError: If the shape is wrong or an action is not finite.
    """
    batch = engine.batch
    numbers = _numbers(actions, (batch, None, components) if rollout else (batch, components))
    if through is not None:
        numbers = through(numbers.reshape(-1, batch, components)).reshape(-1)
    count = numbers.shape[0]
    if on_device(numbers) and not (engine.cuda and count):
        numbers = numbers.cpu().numpy()
    elsewhere = on_device(numbers) and not _in_default_stream()
    if not rollout and not elsewhere:
        return numbers
    # Another stream might reuse a tensor's memory before the kernels have read it.
    array = ti.ndarray(ti.f64, shape=max(1, count))
    if elsewhere:
        # Wait for the actions of the manipulators.
        torch.cuda.current_stream().synchronize()
    if count:
        copy_numbers(array, 0, numbers, count, True)
    if elsewhere:
        ti.sync()
    return array


def _numbers(
    actions: "np.ndarray | torch.Tensor", expected: tuple[int | None, ...]
) -> "np.ndarray | torch.Tensor":
    """Return the actions as a flat float64 array, ordered by step if the number of steps in ``expected`` is
    open (None). CUDA tensors are complete on return. Raise ArgumentError for wrong shapes and non-finite
    actions."""
    try:
        actions = getattr(actions, "detach", lambda: actions)()
        actions = actions if on_device(actions) else np.asarray(actions, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"actions must be a numeric array: {error}") from None
    shape = tuple(actions.shape)
    if len(shape) != len(expected) or any(n not in (None, m) for n, m in zip(expected, shape, strict=True)):
        named = "(batch, components)" if None not in expected else "(batch, steps, components)"
        wanted = ", ".join("T" if n is None else str(n) for n in expected)
        raise ArgumentError(f"actions have shape {shape}, not ({wanted}) {named}")
    if None in expected:
        if not shape[1]:
            raise ArgumentError("actions have no steps: pass at least one, shape (batch, steps, components)")
        actions = actions.swapaxes(0, 1)
    if on_device(actions):
        flat = actions.reshape(-1).double().contiguous()
        finite = bool(flat.isfinite().all())
    else:
        flat = np.ascontiguousarray(actions).reshape(-1)
        finite = bool(np.isfinite(flat).all())
    if not finite:
        raise ArgumentError("actions contain NaN or infinity")
    return flat


def _in_default_stream() -> bool:
    """Return True if PyTorch uses the stream of Taichi's kernels, so that no synchronisation is needed."""
    return bool(torch.cuda.current_stream() == torch.cuda.default_stream())
