"""Running normalisation of observations to mean 0 and standard deviation 1.

It is a part of the policy and not a transform of the env: the statistics are in the policy's own
state, so whoever loads the policy has them, guides see the observations as they are, and an
evaluation never changes them.
"""

import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase

from coil_rl.learners.encoders import entry_specs
from coil_rl.learners.extension import Extension
from coil_rl.learners.policy import KeyModule
from coil_rl.output import say
from coil_rl.transforms.guide_actions import GuideActions

LIMIT = 10.0  # of a normalised number: an outlier must not become a huge input
# An element is out of scale if its deviation is below the first, its size above the second, or
# its mean more than that many deviations from 0; one that never changed is, beyond that number.
SMALL, LARGE, FAR = 0.1, 10.0, 3.0
ROUNDING = 1e-7  # of the size of an element: smaller deviations are that of float32
TINIEST = 1e-60  # variance of an element that was always 0, in any unit
LARGEST = torch.finfo(torch.float64).max  # variance; in place of infinity, which times 0 is NaN
MOST_SHOWN = 4  # elements in a message
PICTURE = "it is a picture"


class Normaliser(KeyModule):
    """Entries of an env, normalised by mean and standard deviation of all that `learn` has seen.

    The results are written as `("normalised", KEY)`. Before the first `learn` they are 0, so that
    no result depends on the unit or the centre of an entry; with `enough` they equal the entries.
    Advice, which shares the unit of the action, and entries of other than floating point numbers
    are a `ValueError`.

    Args:
        env: the env, for its specs.
        keys: the entries.
        enough: None: all of them are normalised. Else `learn` decides which: those with an element
            that is out of scale, see `out_of_scale`, while the others stay as they are. Each
            `learn` decides anew until that many rows were seen; then the decision stays. It is a
            part of the state.
    """

    def __init__(
        self,
        env: EnvBase,
        keys: Sequence[NestedKey],
        *,
        enough: int | None = None,
    ) -> None:
        super().__init__(keys, [unravel_key(("normalised", key)) for key in keys])
        advice = advice_keys(env)
        self.moments = nn.ModuleList()
        for key, spec in zip(keys, entry_specs(env, keys), strict=True):
            if key in advice:
                raise ValueError(
                    f"normalise: {key} is advice, in the unit of the action; leave it out"
                )
            if not spec.dtype.is_floating_point:
                raise ValueError(f"normalise: {key} has numbers of type {spec.dtype}; leave it out")
            shape = spec.shape[len(env.batch_size) :]
            moments = Moments(shape, spec.device, enough=enough)
            if enough is None:
                moments.variance.fill_(math.inf)
            self.moments.append(moments)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the normalised entries."""
        for key, name, moments in zip(self.in_keys, self.out_keys, self.moments, strict=True):
            tensordict.set(name, moments(tensordict[key]))
        return tensordict

    def learn(self, batch: TensorDictBase) -> None:
        """Add the entries of a batch of any shape to the statistics."""
        for key, moments in zip(self.in_keys, self.moments, strict=True):
            undecided = moments.undecided
            moments.add(batch[key])  # type: ignore[operator]
            if undecided:
                wrong = moments.out_of_scale
                moments.used.fill_(wrong.any())  # type: ignore[operator]
                if not moments.undecided:
                    found = ", ".join(moments.described(wrong))  # type: ignore[operator]
                    fate = f"is normalised: {found}" if found else "is in scale and stays as it is"
                    say(f"normalise: {_name(key)} {fate}", error=True)


class RunningStatistics(Extension):
    """Lets a normaliser learn from each batch, after the update.

    The policy has collected the batch with the earlier statistics, and must learn from it with the
    same ones. The statistics are in the state of the policy, so there is no other state.

    Args:
        normaliser: of policy and critic.
    """

    def __init__(self, normaliser: Normaliser) -> None:
        self.normaliser = normaliser

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Add the entries of the batch to the statistics; there are no metrics."""
        self.normaliser.learn(batch)
        return {}


class Moments(nn.Module):
    """Count, mean and variance of each element of all arrays seen so far (Chan et al. 1979).

    Args:
        shape: of an array.
        device: of the statistics; None: PyTorch's default.
        enough: number of arrays that decide whether values are normalised; None: they always are.

    Attributes:
        used: whether values are normalised, a scalar; None: always.
    """

    def __init__(
        self, shape: torch.Size, device: torch.device | None = None, *, enough: int | None = None
    ) -> None:
        super().__init__()
        self.enough = enough
        options: dict[str, Any] = {"dtype": torch.float64, "device": device}
        self.count: Tensor = nn.Buffer(torch.zeros((), **options))
        self.mean: Tensor = nn.Buffer(torch.zeros(shape, **options))
        self.variance: Tensor = nn.Buffer(torch.ones(shape, **options))
        self.used: Tensor | None
        self.register_buffer("used", None if enough is None else torch.tensor(False, device=device))

    def forward(self, values: Tensor) -> Tensor:
        """Normalise values [*batch, *shape]."""
        # Relative, so that the unit of an element does not matter.
        deviation = (self.variance + ROUNDING**2 * self.mean.square() + TINIEST).sqrt()
        scaled = (values - self.mean) / deviation
        scaled = scaled.clamp(-LIMIT, LIMIT).to(values.dtype)
        return scaled if self.used is None else torch.where(self.used, scaled, values)

    @property
    def undecided(self) -> bool:
        """Whether a decision may still change."""
        return self.enough is not None and float(self.count) < self.enough

    @property
    def size(self) -> Tensor:
        """Root of the mean square of each element."""
        return (self.variance + self.mean.square()).sqrt()

    @property
    def out_of_scale(self) -> Tensor:
        """Whether each element is out of scale for a network.

        It is with a deviation below SMALL, a size above LARGE, or a mean of more than FAR
        deviations; if it never changed, with a mean beyond FAR.
        """
        sizes, deviations = self.mean.abs(), self.variance.sqrt()
        constant = deviations <= 1e-6 * sizes
        far = sizes > FAR * torch.where(constant, 1.0, deviations)
        return far | (~constant & ((deviations < SMALL) | (self.size > LARGE)))

    def described(self, chosen: Tensor) -> list[str]:
        """Return index, mean and deviation of some elements as texts; of many the first ones.

        Args:
            chosen: whether each element is one of them.
        """
        means, deviations = self.mean.flatten().tolist(), self.variance.sqrt().flatten().tolist()
        indices = chosen.flatten().nonzero().flatten().tolist()
        texts = [
            f"[{index}] mean {means[index]:.4g} deviation {deviations[index]:.4g}"
            for index in indices[:MOST_SHOWN]
        ]
        return [*texts, "..."] if len(indices) > MOST_SHOWN else texts

    @torch.no_grad()
    def add(self, values: Tensor) -> None:
        """Add values [*batch, *shape]."""
        rows = values.reshape(-1, *self.mean.shape).double()
        mean, variance = rows.mean(0), rows.var(0, correction=0)
        self.count += len(rows)
        share, change = len(rows) / self.count, mean - self.mean
        before = self.variance.clamp(max=LARGEST)
        spread = before * (1 - share) + variance * share + change.square() * share * (1 - share)
        self.mean += change * share
        self.variance.copy_(spread)


def advice_keys(env: EnvBase) -> set[NestedKey]:
    """Return the entries of an env that hold advice."""
    advised = [part.out_keys for part in env.modules() if isinstance(part, GuideActions)]
    return set().union(*advised)


def unmeasured(env: EnvBase, keys: Sequence[NestedKey]) -> dict[NestedKey, str]:
    """Return those of some entries of an env that hold no vectors of measurements, and what else.

    They are advice, choices or images; nothing is said of advice and of whole numbers.
    """
    found, advice = {}, advice_keys(env)
    for key, spec in zip(keys, entry_specs(env, keys), strict=True):
        if key in advice:
            found[key] = ""
        elif spec.dtype == torch.uint8:
            found[key] = "it holds bytes, which networks divide by 255"
        elif len(spec.shape) - len(env.batch_size) >= 3:
            found[key] = PICTURE
        elif isinstance(spec, OneHot | Categorical):  # of several choices at once too
            found[key] = "it holds choices"
        elif not spec.dtype.is_floating_point:
            found[key] = ""
    return found


def normaliser(
    env: EnvBase,
    in_keys: Sequence[NestedKey],
    normalise: bool | Literal["auto"] | Sequence[NestedKey],
    enough: int = 1,
) -> Normaliser | None:
    """Return the normaliser of a learner, None without entries.

    `normalise` names them; True: all of `in_keys` that hold vectors of measurements, that is not
    advice, choices or images; "auto": those of them that are out of scale in the batches with the
    first `enough` rows.
    """
    others = unmeasured(env, in_keys)
    chosen = [key for key in in_keys if normalise and key not in others]
    if normalise is True:
        for key, why in others.items():
            if why:
                warnings.warn(f"normalise=true leaves {_name(key)} as it is: {why}", stacklevel=2)
    elif not isinstance(normalise, (bool, str)):
        chosen = list(normalise)
        if unread := [str(key) for key in chosen if key not in in_keys]:
            raise ValueError(
                f"normalise: {', '.join(unread)} is not observed; "
                f"observed are {', '.join(map(str, in_keys))}"
            )
    if not chosen:
        return None
    return Normaliser(env, chosen, enough=enough if normalise == "auto" else None)


class RawObservations(Extension):
    """Warns once of each observed entry that is used as it is and out of scale; changes nothing.

    Args:
        env: the env, for its specs.
        in_keys: entries that are observed.
        normaliser: of some of them; None: of none.
    """

    def __init__(
        self, env: EnvBase, in_keys: Sequence[NestedKey], normaliser: Normaliser | None
    ) -> None:
        others = unmeasured(env, in_keys)
        self.images = [key for key, why in others.items() if why == PICTURE]
        looked_at = [key for key in in_keys if key not in others or key in self.images]
        # Which moments decide; None: the entry stays as it is.
        self.each: dict[NestedKey, Any] = dict.fromkeys(looked_at)
        if normaliser is not None:
            self.each |= zip(normaliser.in_keys, normaliser.moments, strict=True)
        self.each = {
            key: own for key, own in self.each.items() if own is None or own.used is not None
        }
        self.batch_dims, self.count = len(env.batch_size), 0

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Look at a batch [*B, T]: at the first one, the second, the fourth and so on.

        What is observed may grow while a policy learns.
        """
        self.count += 1
        if self.count & (self.count - 1):
            return {}
        for key, decides in list(self.each.items()):
            if decides is not None and (decides.undecided or decides.used):
                continue
            moments = Moments(batch[key].shape[self.batch_dims + 1 :], batch[key].device)
            moments.add(batch[key])
            if found := moments.described(moments.size > LARGE):
                del self.each[key]
                remedy = f"use learner.normalise={'auto or true' if decides is None else 'true'}"
                now = "is" if decides is None else "is by now"
                if key in self.images:
                    remedy = "a picture of 0 to 255 needs a space of uint8, or a division by 255"
                warnings.warn(
                    f"{_name(key)} is observed as it is, but {now} far out of scale for a network: "
                    f"{', '.join(found)}; {remedy}",
                    stacklevel=2,
                )
        return {}


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))
