"""CUDA tensors of PyTorch in and out of the simulator, without a way through the host.

Taichi and PyTorch work in the same context and in the default stream; a kernel takes a tensor's memory as it
takes an array's.
"""

import numpy as np
import taichi as ti

__all__ = ["on_device", "tensor_from", "write_numbers"]


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
