"""What an episode of an FMU is worth: the ready reward for following setpoints."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coil_rl.ranges import NonNegative, checked

Values = Mapping[str, NDArray[np.float64]]


class Moment(NamedTuple):
    """An FMU at the end of a step, for a reward.

    Attributes:
        time: s, since the begin of the episode.
        outputs: what is observed, by name, an array each.
        inputs: the action that led here, by name.
        setpoints: in the step that ends here, by the name of the output.
    """

    time: float
    outputs: Values
    inputs: Values
    setpoints: Values


@checked
class Follow:
    """Reward for following setpoints: minus the error, and the prices of the action and its change.

    All are in the units of the FMU.

    Args:
        error: "absolute" or "squared", of errors and prices.
        weights: of the error of some outputs, in place of 1.
        action: price of a unit of each input.
        change: price of a unit of its change in a step.

    Example:
        >>> import numpy as np
        >>> from coil_fmu import Follow, Moment
        >>> now = Moment(0.1, {"level": np.array([0.8])}, {}, {"level": np.array([1.0])})
        >>> round(Follow()(now, now), 3)
        -0.2
    """

    def __init__(
        self,
        error: Literal["absolute", "squared"] = "absolute",
        weights: Mapping[str, float] | None = None,
        action: NonNegative = 0.0,
        change: NonNegative = 0.0,
    ) -> None:
        self.size = np.abs if error == "absolute" else np.square
        self.weights, self.action, self.change = dict(weights or {}), action, change

    def __call__(self, now: Moment, before: Moment) -> float:
        """Return the reward of a step.

        Args:
            now: the end of the step.
            before: the end of the step before.
        """
        cost = 0.0
        for name, wanted in now.setpoints.items():
            missing = wanted - now.outputs[name]
            cost += self.weights.get(name, 1.0) * float(self.size(missing).sum())
        for name, value in now.inputs.items():
            cost += self.action * float(self.size(value).sum())
            cost += self.change * float(self.size(value - before.inputs[name]).sum())
        return -cost
