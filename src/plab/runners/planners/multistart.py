"""``multistart``: gradient descent (Adam) from many starts, the worse half replaced as it goes.

To reproduce a result:

    python -m plab.run task=Move variant=1 method=multistart seed=0
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from plab.config import ConfigError, ranges
from plab.runners.libraries import torch
from plab.runners.planners.planner import Asking, CandidateStart, Planner, PlannerConfig, Request
from plab.runners.policy import packed, unpacked

if TYPE_CHECKING:
    from torch import Tensor


@dataclass
class MultistartConfig(PlannerConfig):
    """Gradient descent from many starts.

    Attributes:
        lrs: Learning rates, which candidates have in turn.
        betas: Decay rates of Adam's two moment estimates.
        eps: Added to Adam's denominator.
        updates: Updates of each candidate per iteration.
        softness_end: The softness goes from ``softness`` to this over the iterations, by the same factor in
            each; None: it stays.
        replace_every: Iterations after which the worse half is replaced.
        fresh: Fraction of the replaced candidates with a new start; the others start near a better candidate,
            within ``action_init``.
    """

    lrs: list[float]
    betas: list[float] = field(metadata=ranges.DECAYS)
    eps: float = field(metadata=ranges.POSITIVE)
    updates: int = field(metadata=ranges.COUNT)
    softness_end: float | None = field(metadata=ranges.POSITIVE)
    replace_every: int = field(metadata=ranges.COUNT)
    fresh: float = field(metadata=ranges.UNIT)

    def check(self, path: str) -> None:
        super().check(path)
        if not self.lrs:
            raise ConfigError(f"{path}.lrs is empty: give one learning rate at least")
        for lr in self.lrs:
            ranges.positive(f"{path}.lrs", lr)
        if self.softness_end is not None and self.contact == "hard":
            raise ConfigError(f"{path}.softness_end has no effect with contact=hard: leave it out")


class Multistart(Planner):
    """Gradient descent of candidates, each with its own moments and learning rate."""

    method: MultistartConfig

    def __init__(self, method: MultistartConfig, start: CandidateStart) -> None:
        super().__init__(method, start)
        zeros = torch.zeros((method.population, *start.shape), dtype=torch.float64, device=start.device)
        self._places = [place.clone().requires_grad_() for place in zeros]
        by_rate = [(lr, self._places[k :: len(method.lrs)]) for k, lr in enumerate(method.lrs)]
        groups = [{"params": places, "lr": lr} for lr, places in by_rate if places]
        first, second = method.betas
        self._adam = torch.optim.Adam(groups, betas=(first, second), eps=method.eps)

    def begin(self, random: torch.Generator, found: Tensor) -> None:
        count = self.method.population
        kept = found[: count - round(self.method.fresh * count)]
        self._put(torch.cat([kept, self.start.draw(self.method, count - len(kept), random)]), range(count))

    def iterate(self, random: torch.Generator) -> Asking:
        """Judge the candidates in the hard model, improve all, and replace the worse half if it is time."""
        method, softness = self.method, self._softness()
        actions = self._actions()
        answer = shown = yield Request(actions, gradient=softness is None)
        order = shown.cost(method.objective).argsort(stable=True)
        for update in range(method.updates):
            if update > 0 or softness is not None:
                answer = yield Request(self._actions(), softness, gradient=True)
            self._descend(answer.gradient)
        self.memory["order"] = order
        if (self.iteration + 1) % method.replace_every == 0 and self.iteration + 1 < method.iterations:
            self._replace(order, random)
        return self.show(actions, shown)

    def candidates(self) -> Tensor:
        return self._actions()[self.memory["order"]]

    def _softness(self) -> float | None:
        """Decay rate of the soft contact in this iteration; None in the hard model."""
        method = self.method
        if method.contact == "hard":
            return None
        end = method.softness if method.softness_end is None else method.softness_end
        return method.softness * (end / method.softness) ** (self.iteration / max(method.iterations - 1, 1))

    def _actions(self) -> Tensor:
        return torch.stack([place.detach() for place in self._places])

    def _put(self, actions: Tensor, numbers: Any) -> None:
        """Put candidates, shape [N, T, A], into places, where they start without moments."""
        for place, own in zip(numbers, actions, strict=True):
            self._places[place].data.copy_(own.clamp(-1.0, 1.0))
            self._adam.state.pop(self._places[place], None)

    def _descend(self, gradient: Tensor | None) -> None:
        """Make a step of Adam by gradients of shape [P, T, A]."""
        assert gradient is not None
        for place, own in zip(self._places, gradient, strict=True):
            place.grad = own
        self._adam.step()
        for place in self._places:
            place.data.clamp_(-1.0, 1.0)

    def _replace(self, order: Tensor, random: torch.Generator) -> None:
        """Replace the worse half of the candidates, some by new starts, some by neighbours of better ones."""
        better, worse = order.tensor_split([(len(order) + 1) // 2])
        fresh = self.start.draw(self.method, round(self.method.fresh * len(worse)), random)
        beside = len(worse) - len(fresh)
        unit = torch.rand(
            (beside, *self.start.shape), generator=random, dtype=torch.float64, device=order.device
        )
        moved = self._actions()[better[:beside]] + (2.0 * unit - 1.0) * self.method.action_init
        self._put(torch.cat([moved, fresh]), worse.tolist())

    def state(self) -> dict[str, Any]:
        moments = {k: self._adam.state[p] for k, p in enumerate(self._places) if p in self._adam.state}
        kept = packed({"actions": self._actions(), "moments": moments})
        return super().state() | {"torch": kept}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        kept = unpacked(state["torch"])
        self._put(kept["actions"], range(len(self._places)))
        for k, own in kept["moments"].items():
            # The number of steps stays on the CPU, as Adam has it.
            on = {name: v if name == "step" else v.to(self._places[k].device) for name, v in own.items()}
            self._adam.state[self._places[k]] = on
