"""Steps of an optimiser on the losses of minibatches, as they are or as machine code.

The weights of a network can be one vector, so that a step takes one operation for all of them.
"""

import copy
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from coil_rl.compiled import Compiled
from coil_rl.errors import UserError
from coil_rl.learners.learner import Stateful
from coil_rl.learners.policy import Entries
from coil_rl.ranges import checked

ENOUGH = 4_000  # steps of a run, for which compilation pays in the second run of the same sizes


@checked
@dataclass(eq=False)
class GradientStep(Stateful):
    """One step of Adam on the weighted losses of a minibatch.

    Args:
        losses: returns scalars by name for a minibatch, and other tensors that are reported.
        groups: parameters, grouped by learning rate.
        reads: other tensors that the losses, or `after`, read or change.
        rates: returns the learning rate of each group for the progress of the run.
        eps: of Adam.
        betas: of Adam.
        max_grad_norm: gradients are scaled down to this norm, over all parameters together; None:
            they stay as they are.
        after: is called after each step.
        compile: whether to compile the step, which changes the last digits; "auto": from the second
            update with steps on, if the run will have `ENOUGH` steps or more.
        compilable: whether the step can be compiled on a CPU; on a GPU none can.

    Raises:
        ValueError: for another value of `compile`, and for true if the step cannot be compiled.
    """

    parts: ClassVar[tuple[str, ...]] = ("adam", "steps", "begun", "compile")

    losses: Callable[[Any], Mapping[str, Tensor]]
    groups: Sequence[Sequence[nn.Parameter]]
    reads: Sequence[Tensor]
    rates: Callable[[float], Sequence[float]]
    _: KW_ONLY
    eps: float
    betas: tuple[float, float] = (0.9, 0.999)
    max_grad_norm: float | None
    after: Callable[[], Any] | None = None
    compile: bool | Literal["auto"] = "auto"
    compilable: bool = True

    def __post_init__(self) -> None:
        self.required = self.compile is True
        if self.required and not self.compilable:
            raise ValueError(
                "compile=true: this learner's update depends on data in its shapes; take "
                "compile=auto"
            )
        self.parameters = [parameter for group in self.groups for parameter in group]
        on_cpu = all(parameter.device.type == "cpu" for parameter in self.parameters)
        if self.required and not on_cpu:
            raise ValueError("compile=true: code is compiled for the CPU only; take compile=auto")
        self.compile = self.compile if self.compilable and on_cpu else False
        self.adam = torch.optim.Adam(
            [{"params": group} for group in self.groups],
            eps=self.eps,
            betas=self.betas,
            fused=True,
        )
        self.compiled = Compiled(self._on_tensors)
        self.steps, self.begun = 0, 0.0  # progress of the run at the first step
        self.names: list[str] = []  # of the losses
        self.keys: list[Any] = []
        self.weighted: list[str] = []
        self.state: list[Tensor] = []  # all tensors that a step reads, besides its minibatch

    def begin(self, progress: float) -> None:
        """Set the learning rates of an update, and decide whether "auto" compiles from it on."""
        for group, rate in zip(self.adam.param_groups, self.rates(progress), strict=True):
            group["lr"] = rate
        if not self.steps:
            self.begun = progress
        elif self.compile == "auto" and progress > self.begun:
            self.compile = self.steps * (1 - self.begun) / (progress - self.begun) >= ENOUGH

    def __call__(self, minibatch: Any, weights: Mapping[str, float]) -> dict[str, Tensor]:
        """Take a step on the sum of the losses times `weights`.

        Returns what `losses` returns, detached.

        Raises:
            UserError: if `compile` was given as true and there is no C++ compiler.
        """
        self.steps += 1
        if self.compile is True:
            try:
                return self._compiled(minibatch, weights)
            except UserError as error:
                if self.required:
                    raise
                warnings.warn(f"{error}; the update goes on uncompiled", stacklevel=2)
                self.compile = False
        losses = self.losses(minibatch)
        self.minimise(
            sum(
                losses[name] if weight == 1 else weight * losses[name]
                for name, weight in weights.items()
            )
        )
        return {name: each.detach() for name, each in losses.items()}

    def _compiled(self, minibatch: Any, weights: Mapping[str, float]) -> dict[str, Tensor]:
        self.keys = list(minibatch)
        self.weighted = list(weights)
        rates = [group["lr"] for group in self.adam.param_groups]
        numbers = torch.tensor([*weights.values(), *rates], device=self.parameters[0].device)
        self.state = self.state or self._state()
        values = self.compiled(numbers, *(minibatch[key] for key in self.keys), *self.state)
        return dict(zip(self.names, values, strict=True))

    def minimise(self, loss: Any) -> None:
        """Take a step on a loss."""
        for parameter in self.parameters:  # `zero_grad` does the same, but is as slow as the step
            parameter.grad = None
        loss.backward()
        if self.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        self._step()

    def _step(self) -> None:
        self.adam.step()
        if self.after is not None:
            self.after()

    def _state(self) -> list[Tensor]:
        state = self.adam.state
        for parameter in self.parameters:
            if parameter not in state:  # as Adam does at the first step
                moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                state[parameter] = {"step": torch.zeros((), device=parameter.device), **moments}
        of_adam = [each for parameter in self.parameters for each in state[parameter].values()]
        tensors = [*self.parameters, *of_adam, *self.reads]
        return list({id(tensor): tensor for tensor in tensors}.values())  # each once

    def _on_tensors(self, numbers: Tensor, *tensors: Tensor) -> list[Tensor]:
        """Take a step on the entries of a minibatch, for compilation.

        `tensors` are the entries `keys`, then those of `_state`.
        """
        minibatch = Entries(zip(self.keys, tensors, strict=False))
        count = len(self.weighted)
        weights, rates = numbers[:count].unbind(0), numbers[count:].unbind(0)
        losses = self.losses(minibatch)
        self.names = list(losses.keys())
        total: Any = sum(
            weight * losses[name] for name, weight in zip(self.weighted, weights, strict=True)
        )
        with self._traceable(rates):
            gradients = torch.autograd.grad(total, self.parameters, allow_unused=True)
            for parameter, gradient in zip(self.parameters, gradients, strict=True):
                parameter.grad = gradient
            if self.max_grad_norm is not None:
                torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm, foreach=False)
            self._step()
        # Copies, as a result may be an argument.
        return [each.detach().clone() for each in losses.values()]

    @contextmanager
    def _traceable(self, rates: Sequence[Tensor]) -> Iterator[None]:
        """Let the optimiser use learning rates that are tensors, and single operations."""
        groups = self.adam.param_groups
        before = [dict(group) for group in groups]
        for group, rate in zip(groups, rates, strict=True):
            group.update(lr=rate, fused=False, foreach=False, capturable=True)
        try:
            yield
        finally:
            for group, values in zip(groups, before, strict=True):
                group.update(values)
            for parameter in self.parameters:
                parameter.grad = None

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        super().load_state_dict(state)
        self.state = []


def means(steps: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
    """Return the means of the scalars that some steps returned, by name."""
    names = [name for name, value in steps[0].items() if not value.ndim] if steps else []
    if not names:
        return {}
    values = torch.stack([torch.stack([step[name] for name in names]) for step in steps])
    return dict(zip(names, values.mean(0).tolist(), strict=True))


def tensors_of(*modules: nn.Module) -> list[Tensor]:
    """Return all parameters and buffers of some modules."""
    return [each for module in modules for each in (*module.parameters(), *module.buffers())]


class Weights:
    """All parameters of a module in one vector.

    The parameters of the module become views of it. So whoever computes with the module, saves it
    or loads it has the numbers of the vector, while an optimiser has one tensor to change.
    Gradients reach the vector where the module is `used`.

    Args:
        module: its parameters have one type.

    Attributes:
        vector: the numbers, [n].
    """

    def __init__(self, module: nn.Module) -> None:
        self.places: list[tuple[dict[str, Any], str]] = []
        for part in module.modules():
            own = part._parameters
            self.places += [(own, name) for name, each in own.items() if each is not None]
        parameters: list[nn.Parameter] = [table[name] for table, name in self.places]
        self.shapes = [parameter.shape for parameter in parameters]
        self.sizes = [parameter.numel() for parameter in parameters]
        flat = [parameter.detach().reshape(-1) for parameter in parameters]
        self.vector = nn.Parameter(torch.cat(flat))
        self._join()

    def _join(self) -> None:
        """Make the parameters views of the vector."""
        views = self._views(self.vector.detach())
        for (table, name), view in zip(self.places, views, strict=True):
            table[name].data = view

    def __deepcopy__(self, memo: dict[int, Any]) -> "Weights":
        """Return a copy whose vector is that of the copied module; PyTorch copies each alone."""
        copied = object.__new__(Weights)
        vars(copied).update(copy.deepcopy(vars(self), memo))
        copied._join()
        return copied

    def _views(self, vector: Tensor) -> list[Tensor]:
        parts = vector.split(self.sizes)
        return [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]

    @contextmanager
    def used(self, *, fixed: bool = False) -> Iterator[None]:
        """Let the module compute with views of the vector, which get gradients unless `fixed`."""
        own = [table[name] for table, name in self.places]
        views = self._views(self.vector.detach() if fixed else self.vector)
        for (table, name), view in zip(self.places, views, strict=True):
            table[name] = view
        try:
            yield
        finally:
            for (table, name), parameter in zip(self.places, own, strict=True):
                table[name] = parameter
