"""The controller that everybody has: PID loops, on tensors.

    e = r - y                                                   what is missing
    I <- I + ki dt e                                            unless the output is at a limit
    D <- a D + (1 - a) (x - x_before) / dt,   a = T / (T + dt)  x = -y, or e
    u = kp e + I + kd D + kf f + bias                           within the limits

Each is the backward difference of the textbook form kp + ki / s + kd s / (1 + T s).
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import TensorDictPrimer

from coil_rl.ranges import NonNegative, Positive, checked
from coil_rl.transforms.action_space import ActionSpace, OwnForms, nested_key, written_key
from coil_rl.transforms.guide_memory import primer_of
from coil_rl.transforms.hosted import ToldGuide

Numbers = float | Sequence[float]
Entries = str | Sequence[Any]
MEMORY = ("pid_integral", "pid_rate", "pid_before")
FASTEST, SLOWEST, WIDE = 2.0, 1000.0, 20.0  # of the integral, in steps; of a gain, as a factor


class _Source(NamedTuple):
    """An entry, one number of it, or a constant where there is no entry."""

    key: NestedKey | None
    place: int | None
    value: float


@checked
class PID(ToldGuide):
    """PID guide, in the units of the env; several loops are a list in each argument.

    Loop i moves coordinate i of the action. The integral stands still while the output is at a
    limit and the error would push it further (anti-windup). The memory is in entries, so that an
    exported policy has the guide inside.

    Args:
        measured: entry of y, such as "speed"; [observation, 2] is a number of a vector.
        setpoint: entry of r, or a number.
        kp: action per unit of error.
        ki: action per unit of error and second.
        kd: action per unit of error per second.
        filter: s, time constant T of the derivative.
        kf: action per unit of `feed`.
        feed: entry that is fed forward, such as a measured disturbance; None: the setpoint.
        bias: of the action.
        derivative: of what is "measured", so that a step of the setpoint does not kick, or of the
            "error".
        low: lower limit of the action; None: that of the env, which holds anyway.
        high: upper limit of the action.
        step: s, between two actions; None: 1, so that gains are per step.

    Raises:
        ValueError: for lists of different lengths, and in an env with another number of actions, or
            with choices.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> guide = PID("level", 2.0, kp=3.0)
        >>> memory = {name: torch.zeros(1, 1, dtype=torch.float64) for name in MEMORY}
        >>> level, first = torch.tensor([[1.5]]), torch.ones(1, 1, dtype=torch.bool)
        >>> guide(TensorDict({"level": level, "is_init": first, **memory}, [1]))["action"].item()
        1.5
    """

    def __init__(
        self,
        measured: Entries,
        setpoint: float | Entries = 0.0,
        kp: Numbers = 1.0,
        ki: Numbers = 0.0,
        kd: Numbers = 0.0,
        filter: NonNegative = 0.0,
        kf: Numbers = 0.0,
        feed: Entries | None = None,
        bias: Numbers = 0.0,
        derivative: Literal["measured", "error"] = "measured",
        low: Numbers | None = None,
        high: Numbers | None = None,
        step: Positive | None = None,
    ) -> None:
        given = {
            "measured": measured,
            "setpoint": setpoint,
            "feed": setpoint if feed is None else feed,
        }
        self.sources = {name: _sources(name, each) for name, each in given.items()}
        self.count = len(self.sources["measured"])
        keys = [each.key for part in self.sources.values() for each in part if each.key is not None]
        self.in_keys = [*dict.fromkeys(keys), "is_init", *MEMORY]
        self.out_keys = ["action", *(("next", name) for name in MEMORY)]
        super().__init__()
        for name, part in self.sources.items():
            self._check_length(name, len(part))
        numbers = {"kp": kp, "ki": ki, "kd": kd, "kf": kf, "bias": bias}
        limits = {
            "low": -torch.inf if low is None else low,
            "high": torch.inf if high is None else high,
        }
        rows = [self._row(name, value) for name, value in (numbers | limits).items()]
        self.numbers: Tensor = nn.Buffer(torch.stack(rows), persistent=False)
        self.of_error, self.step = derivative == "error", step or 1.0
        self.old = filter / (filter + self.step)

    def _check_length(self, name: str, length: int) -> None:
        if length not in (1, self.count):
            raise ValueError(
                f"{name} has {length} values, but measured names {self.count} loops; give one "
                "value, or one for each"
            )

    def _row(self, name: str, value: Numbers) -> Tensor:
        """Return the numbers of all loops."""
        row = torch.as_tensor(value, dtype=torch.float64).reshape(-1)
        self._check_length(name, len(row))
        return row.expand(self.count)

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Keep within the bounds of the env; a `ValueError` for actions that loops cannot move."""
        if not space.continuous:
            raise ValueError("a PID moves numbers, but the actions of this env are choices")
        if space.size != self.count:
            raise ValueError(
                f"the action has {space.size} numbers, but the PID {self.count} loops; give "
                "measured an entry for each number"
            )
        if space.bounds is not None:
            low, high = (bound.reshape(-1).to(self.numbers) for bound in space.bounds)
            self.numbers[5] = torch.maximum(self.numbers[5], low)
            self.numbers[6] = torch.minimum(self.numbers[6], high)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, and what is remembered."""
        y, r, f = (self._read(tensordict, name) for name in ("measured", "setpoint", "feed"))
        integral, rate, before = (tensordict[name] for name in MEMORY)
        slope = r - y if self.of_error else -y
        change = (slope - torch.where(tensordict["is_init"], slope, before)) / self.step
        rate = self.old * rate + (1 - self.old) * change
        action, integral = self._act(r - y, integral, rate, f)
        tensordict.set("action", action.to(tensordict[self.in_keys[0]].dtype))
        for name, value in zip(MEMORY, (integral, rate, slope), strict=True):
            tensordict.set(("next", name), value)
        return tensordict

    def _act(
        self, error: Tensor, integral: Tensor, rate: Tensor, fed: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the action and the next integral, [*batch, loops]."""
        kp, ki, kd, kf, bias, low, high = self.numbers.unbind(0)
        added = ki * self.step * error
        wanted = kp * error + integral + added + kd * rate + kf * fed + bias
        stuck = ((wanted > high) & (added > 0)) | ((wanted < low) & (added < 0))
        return wanted.clamp(low, high), torch.where(stuck, integral, integral + added)

    def _read(self, tensordict: TensorDictBase, name: str) -> Tensor:
        """Return the values of all loops, [*batch, loops] in float64."""
        batch, parts = tensordict["is_init"].shape[:-1], []
        for source in self.sources[name]:
            if source.key is None:
                parts.append(self.numbers.new_full(batch, source.value))
                continue
            value = tensordict[source.key]
            size = value.shape[-1]
            if source.place is not None and not -size <= source.place < size:
                raise ValueError(
                    f"{name}=[{written_key(source.key)},{source.place}] must be one of {size} "
                    "numbers, counted from 0"
                )
            if source.place is None and size != 1:
                raise ValueError(
                    f"{name}={written_key(source.key)} has {size} numbers; give "
                    f"{name}=[{written_key(source.key)},INDEX] for one of them"
                )
            parts.append(value[..., source.place or 0].double())
        read = torch.stack(parts, -1)
        return read.expand(*batch, self.count)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare integral, filtered rate and last value as memory."""
        return primer_of(dict.fromkeys(MEMORY, torch.zeros(self.count, dtype=torch.float64)))

    @staticmethod
    def tunable(arguments: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Return the bounds of `tune=auto`: gains that are not 0, and the integral of P.

        A gain may be a twentieth to twenty times what it is; an integral takes two to a thousand
        steps for the action of the proportional part.

        Args:
            arguments: of the guide.
        """
        found: dict[str, list[Any]] = {}
        step = arguments.get("step") or 1.0
        for name in ("kp", "ki", "kd", "kf"):
            given, kps = arguments.get(name, float(name == "kp")), arguments.get("kp", 1.0)
            for index, own in enumerate(given if isinstance(given, Sequence) else [given]):
                kp = kps[index % len(kps)] if isinstance(kps, Sequence) else kps
                sizes = [abs(own) / WIDE, abs(own) * WIDE] if own else []
                if name == "ki" and kp:
                    sizes += [abs(kp) / (SLOWEST * step), abs(kp) / (FASTEST * step)]
                if sizes:
                    key = f"{name}.{index}" if isinstance(given, Sequence) else name
                    low, high = min(sizes), max(sizes)
                    negative = (own or kp) < 0
                    found[key] = [-high, -low] if negative else [low, high, "log"]
        return found


def _sources(name: str, given: Any) -> list[_Source]:
    """Return where the value of each loop is.

    Args:
        name: of the argument, for the message.
        given: an entry, [ENTRY, INDEX], a number, or a list of such.
    """
    if isinstance(given, (int, float)):
        return [_Source(None, None, float(given))]
    if isinstance(given, str):
        return [_Source(given, None, 0.0)]
    parts = list(given)
    if len(parts) > 1 and isinstance(parts[-1], int) and isinstance(parts[0], str):
        return [_Source(nested_key(parts[:-1]), parts[-1], 0.0)]
    if not parts:
        raise ValueError(f"{name} names no entry; give one, or [ENTRY,INDEX]")
    found = []
    for part in parts:
        if isinstance(part, Sequence) and all(isinstance(each, str) for each in part):
            found.append(
                _Source(nested_key(part if isinstance(part, str) else list(part)), None, 0.0)
            )
        else:
            found += _sources(name, part)
    return found
