"""Arrays and CUDA tensors of PyTorch in and out of the simulator; the latter without a way through the host.

Taichi and PyTorch work in the same context and in the default stream; a kernel takes a tensor's memory as it
takes an array's.
"""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

if TYPE_CHECKING:
    import torch

__all__ = ["action_array", "numbers_of", "on_device", "tensor_from", "write_numbers"]


def on_device(array: object) -> bool:
    """Whether something is a CUDA tensor; PyTorch is not imported for that."""
    return bool(getattr(array, "is_cuda", False))


@ti.kernel
def write_numbers(source: ti.types.ndarray(ndim=1), target: ti.types.ndarray(ndim=1)):
    """Copy numbers from the start of one array to the start of another, in its type."""
    for i in range(ti.min(source.shape[0], target.shape[0])):
        target[i] = source[i]


def tensor_from(array: ti.Ndarray, shape: tuple[int, ...], like: object) -> object:
    """Copy an array of scalars to a new tensor.

    Args:
        array: Array on the CUDA device.
        shape: Shape of the tensor; what the array holds beyond it is left out.
        like: A CUDA tensor, whose device and type the new one takes.
    """
    out = like.new_empty(int(np.prod(shape)))
    if out.numel():
        write_numbers(array, out)
        # The caller may go on in a stream of its own.
        ti.sync()
    return out.reshape(shape)


def numbers_of(array: ti.Ndarray, shape: tuple[int, ...], like: object) -> "np.ndarray | torch.Tensor":
    """What an array on the device holds, as a tensor like a CUDA tensor or else as an array.

    Args:
        array: Array on the device of the simulation.
        shape: Shape of the result; what the array holds beyond it is left out.
        like: Given a CUDA tensor, the result is one too, as :func:`tensor_from` makes it.
    """
    if on_device(like):
        return tensor_from(array, shape, like)
    return array.to_numpy()[: int(np.prod(shape))].reshape(shape)


def action_array(
    actions: "np.ndarray | torch.Tensor", batch: int, components: int, device: str, steps: int | None = None
) -> ti.Ndarray:
    """Actions for the kernels.

    Args:
        actions: Shape [batch, T, action], or [batch, action] if ``steps`` is 1.
        batch: Number of environments.
        components: Action components per environment step.
        device: Device of the simulation, ``cpu`` or ``cuda``.
        steps: 1 for the actions of one step without an axis of steps, or None.

    Returns:
        Actions of all environments, step by step, float64.

    Raises:
        ValueError: If the shape is wrong or an action is not finite.
    """
    actions = actions if on_device(actions) else np.asarray(actions, np.float64)
    expected = (batch, components)
    if steps is None:
        expected = (batch, actions.shape[1] if actions.ndim == 3 else "T", components)
    if tuple(actions.shape) != expected:
        named = " (batch, steps, components)" if steps is None else " (batch, components)"
        raise ValueError(f"actions have shape {tuple(actions.shape)}, not {expected}{named}")
    finite = actions.isfinite() if on_device(actions) else np.isfinite(actions)
    if not finite.all():
        raise ValueError("actions contain NaN or infinity")
    flat = actions.swapaxes(0, 1).reshape(-1) if steps is None else actions.reshape(-1)
    array = ti.ndarray(ti.f64, shape=max(1, flat.shape[0]))
    if not flat.shape[0]:
        return array
    if on_device(actions) and device == "cuda":
        write_numbers(flat.detach().contiguous(), array)
    else:
        array.from_numpy(np.ascontiguousarray(flat.cpu().double() if on_device(flat) else flat))
    return array
