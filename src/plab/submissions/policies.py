"""Policies as others hand them in: TorchScript or ONNX. Loading one executes what is in it."""

from __future__ import annotations

import io
from collections.abc import Callable
from importlib.util import find_spec
from typing import TypeAlias

import numpy as np

from plab.submissions.schema import SubmissionError

__all__ = ["Policy", "load"]

Policy: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""From observations, float32, shape [batch, entry], to actions, shape [batch, action]."""


def load(name: str, content: bytes) -> Policy:
    """Make a policy callable; the ending of its file's name says of which kind it is.

    What it answers with is finite actions of the right number, or a SubmissionError of one line.

    Raises:
        SubmissionError: If it cannot be loaded, or ONNX Runtime is missing.
    """
    kinds = {".pt": _torchscript, ".onnx": _onnx}
    policy = next(make for end, make in kinds.items() if name.endswith(end))(name, content)

    def answer(observations: np.ndarray) -> np.ndarray:
        try:
            actions = np.asarray(policy(observations), np.float64)
        # Whatever its author's code or the runtime raises.
        except Exception as error:
            raise SubmissionError(f"{name} cannot be run ({_first(error)})") from None
        if actions.ndim != 2 or len(actions) != len(observations):
            raise SubmissionError(f"{name} gives actions of shape {list(actions.shape)}, not [batch, action]")
        if not np.isfinite(actions).all():
            raise SubmissionError(f"{name} gives actions that are not finite")
        return np.clip(actions, -1.0, 1.0)

    return answer


def _torchscript(name: str, content: bytes) -> Policy:
    import torch

    try:
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise SubmissionError(f"{name} is no TorchScript module ({_first(error)})") from None

    def policy(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return module(torch.from_numpy(observations)).numpy()

    return policy


def _onnx(name: str, content: bytes) -> Policy:
    if find_spec("onnxruntime") is None:
        raise SubmissionError(f"{name} needs ONNX Runtime: pip install 'plab[onnx]'")
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        (given,) = session.get_inputs()
    # ONNX Runtime has exceptions of its own, each derived from Exception alone.
    except Exception as error:
        raise SubmissionError(f"{name} is no ONNX model of one input ({_first(error)})") from None
    return lambda observations: session.run(None, {given.name: observations})[0]


def _first(error: Exception) -> str:
    """Return the last line of an error's message: PyTorch puts the reason there, below its trace."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__
