"""Batched networks of many agents: stacked parameters of Stable-Baselines3's policies, and their updates.

An update of these small networks has a hundred kernels of a few microseconds each, dominated by the time to
launch them from Python. On CUDA updates are captured as a graph and replayed with one launch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from plab.plugins import torch

if TYPE_CHECKING:
    from torch import Tensor, nn
    from torch.optim import Adam, Optimizer

Part: TypeAlias = "dict[str, Tensor]"
"""Parameters by name in their module, each of shape [stack, ...]; weights are stored transposed, [stack, in,
out], to avoid transposing products and gradients."""


class Networks:
    """The parameters of K policies of one kind, stacked; a part is a module, or several of the same shape.

    Modules that are evaluated together, such as two critics, form one part; its stack has the modules of the
    first agent, then those of the second, etc.
    """

    def __init__(
        self, policies: Sequence[nn.Module], parts: Mapping[str, Sequence[str]], device: torch.device
    ) -> None:
        """Stack copies of the policies' parameters; ``parts`` names the modules of each part in a policy."""
        named = [dict(policy.named_parameters()) for policy in policies]
        self._modules = {part: tuple(modules) for part, modules in parts.items()}
        self._count = len(policies)
        self.parts: dict[str, Part] = {}
        for part, modules in parts.items():
            # Of a module "a.b" the parameter "a.b.weight" is "weight", of a parameter "a" itself the name "".
            names = [n[len(modules[0]) :] for n in named[0] if f"{n}.".startswith(f"{modules[0]}.")]
            self.parts[part] = {
                name.lstrip("."): torch.stack([_transposed(own[m + name]) for own in named for m in modules])
                .to(device)
                .requires_grad_()
                for name in names
            }

    def __getitem__(self, part: str) -> Part:
        return self.parts[part]

    def parameters(self, *parts: str) -> list[Tensor]:
        """Return the stacked parameters of some parts; of all if none is named."""
        return [tensor for part in parts or self.parts for tensor in self.parts[part].values()]

    def write_to(self, policy: nn.Module, agent: int) -> None:
        """Copy the parameters of an agent to a policy."""
        own = dict(policy.named_parameters())
        with torch.no_grad():
            for part, modules in self._modules.items():
                for name, tensor in self.parts[part].items():
                    rows = tensor.reshape(self._count, len(modules), *tensor.shape[1:])[agent]
                    for module, row in zip(modules, rows, strict=True):
                        own[f"{module}.{name}".rstrip(".")].copy_(_transposed(row))


def _transposed(parameter: Tensor) -> Tensor:
    return parameter.detach().mT if parameter.ndim == 2 else parameter.detach()


def flat(tensors: Sequence[Tensor], agents: int) -> Tensor:
    """Return stacked tensors as one row per agent, shape [agent, number]."""
    return torch.cat([tensor.detach().reshape(agents, -1) for tensor in tensors], dim=1)


def fill(tensors: Sequence[Tensor], agents: int, agent: int, row: Tensor) -> None:
    """Write an agent's row of :func:`flat` back into stacked tensors."""
    own = [tensor.detach().view(agents, -1)[agent] for tensor in tensors]
    for part, numbers in zip(own, row.split([part.numel() for part in own]), strict=True):
        part.copy_(numbers)


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return x W + b for each network: shapes [stack, row, in], [stack, in, out], [stack, out]."""
    return torch.baddbmm(bias.unsqueeze(1), x, weight)


def mlp(x: Tensor, part: Part, name: str, activation: Callable[[Tensor], Tensor], *, last: bool) -> Tensor:
    """Evaluate stacked ``nn.Sequential`` of linear layers, named ``name`` in the part or the part itself,
    for x of shape [stack, row, in]; an activation is after each, but the last if ``last``."""
    prefix = f"{name}." if name else ""
    numbers = [int(n[len(prefix) : -len(".weight")]) for n in part if n.startswith(prefix) and "weight" in n]
    for number in sorted(numbers):
        x = linear(x, part[f"{prefix}{number}.weight"], part[f"{prefix}{number}.bias"])
        x = x if last and number == max(numbers) else activation(x)
    return x


def twin_values(part: Part, observations: Tensor, actions: Tensor) -> Tensor:
    """Return the values that two stacked critics give, shape [agent, 2, row]."""
    pairs = torch.cat([observations, actions], dim=2).repeat_interleave(2, dim=0)
    return mlp(pairs, part, "", torch.relu, last=True).view(len(observations), 2, -1)


def adam(parameters: Sequence[Tensor], lr: float, **options: Any) -> Adam:
    """Return Adam for stacked parameters, with its state allocated in advance; one step updates all
    agents."""
    optimizer = torch.optim.Adam(parameters, lr=lr, fused=True, **options)
    for parameter in parameters:
        optimizer.state[parameter] = {
            "step": torch.zeros((), device=parameter.device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    if parameters[0].is_cuda:
        require_capturable(optimizer, lr)
    return optimizer


def descend(optimizer: Adam, losses: Tensor, longest: float | None = None) -> None:
    """Make one step of an optimiser on the independent losses of the agents, shape [agent]; the gradient of
    each agent is clipped to the norm ``longest``."""
    parameters = optimizer.param_groups[0]["params"]
    gradients = torch.autograd.grad(losses.sum(), parameters)
    if longest is not None:
        agents = len(losses)
        norms = torch.linalg.vector_norm(flat(gradients, agents), dim=1)
        scale = (longest / (norms + 1e-6)).clamp(max=1.0)
        gradients = tuple((g.reshape(agents, -1) * scale.unsqueeze(1)).reshape(g.shape) for g in gradients)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        # A step of all at once takes the numbers as they lie in memory.
        parameter.grad = gradient.contiguous()
    optimizer.step()


def follow(targets: list[Tensor], sources: list[Tensor], tau: float) -> None:
    """Update targets: target <- (1 - tau) target + tau source."""
    with torch.no_grad():
        torch._foreach_lerp_(targets, sources, tau)


# -------------------------------------------------------------------------------------- CUDA graphs

WARM_UP = 3
"""Number of updates before graph capture, in which libraries and optimisers allocate memory."""


class CapturedUpdate:
    """An update of a model; on CUDA it is captured once per shape of its arguments and then replayed.

    The function may change parameters and optimisers in place, and may draw random numbers of the device. It
    must not synchronise with the device, and all data besides its arguments must keep their addresses.
    """

    def __init__(self, update: Callable[..., Tensor]) -> None:
        """Wrap an update, a function of tensors that returns a tensor."""
        self._update = update
        # By shapes of the arguments: graph, input tensors, and output tensor.
        self._recordings: dict[Any, tuple[torch.cuda.CUDAGraph, tuple[Tensor, ...], Tensor]] = {}
        self._calls = 0

    def __call__(self, *arguments: Tensor) -> Tensor:
        """Update; the next call overwrites the returned tensor."""
        if not arguments[0].is_cuda:
            return self._update(*arguments)
        self._calls += 1
        if self._calls <= WARM_UP:
            return self._warm_up(*arguments)
        shapes = tuple(argument.shape for argument in arguments)
        if shapes not in self._recordings:
            self._recordings[shapes] = self._record(*arguments)
        graph, own, result = self._recordings[shapes]
        for mine, given in zip(own, arguments, strict=True):
            mine.copy_(given)
        graph.replay()
        return result

    def _warm_up(self, *arguments: Tensor) -> Tensor:
        # In a separate stream, as required for capture.
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = self._update(*arguments)
        current.wait_stream(stream)
        return result

    def _record(self, *arguments: Tensor) -> tuple[torch.cuda.CUDAGraph, tuple[Tensor, ...], Tensor]:
        own = tuple(argument.clone() for argument in arguments)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = self._update(*own)
        return graph, own, result


def require_capturable(optimizer: Optimizer, lr: float) -> None:
    """Store Adam's learning rate in a CUDA tensor, and make its step capturable."""
    for group in optimizer.param_groups:
        group["capturable"] = True
        if isinstance(group["lr"], torch.Tensor):
            group["lr"].fill_(lr)
        else:
            group["lr"] = torch.tensor(lr, device=group["params"][0].device)
