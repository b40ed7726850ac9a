"""Any regressor of scikit-learn as a module whose state can be kept without pickle."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
import skops.io
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone, is_regressor
from sklearn.ensemble import ExtraTreesRegressor, RandomForestRegressor
from sklearn.utils import get_tags
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.imitation.regressor import Regressor

Array = NDArray[np.floating]

FORESTS = (RandomForestRegressor, ExtraTreesRegressor)

# What skops does not trust by itself, of scikit-learn's own regressors: numbers to compute with, and no code. skops is
# careful because a forged tree can point beyond its own end, which may crash the process.
TRUSTED = (
    "sklearn._loss.loss.HalfTweedieLossIdentity",
    "sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor",
    "sklearn.gaussian_process.kernels.ConstantKernel",
    "sklearn.gaussian_process.kernels.Product",
    "sklearn.gaussian_process.kernels.RBF",
    "sklearn.metrics._dist_metrics.EuclideanDistance64",
    "sklearn.neighbors._kd_tree.KDTree",
    "sklearn.neural_network._stochastic_optimizers.AdamOptimizer",
    "sklearn.tree._tree.Tree",
)


class Sklearn(Regressor):
    """A regressor of scikit-learn, pipelines and searches included.

    Its state is one tensor of bytes, the archive that skops makes of the fitted regressor. Where the regressor draws
    random numbers and no `random_state` is given, that is 0.

    Args:
        estimator: what to fit; only its parameters are used.

    Raises:
        ValueError: if it is no regressor of scikit-learn.

    Example:
        >>> from sklearn.linear_model import LinearRegression
        >>> x = torch.rand(8, 2)
        >>> regressor = Sklearn(LinearRegression()).fresh(inputs=2, outputs=1)
        >>> regressor.fit(x, x[:, :1] - x[:, 1:])
        >>> regressor(torch.tensor([3.0, 1.0])).round(decimals=3)
        tensor([2.])
    """

    def __init__(self, estimator: BaseEstimator) -> None:
        super().__init__()
        if not isinstance(estimator, BaseEstimator) or not is_regressor(estimator):
            raise ValueError(
                f"estimator={estimator!r} is no regressor of scikit-learn; give one, such as LinearRegression()"
            )
        self.estimator = _with(clone(estimator), "random_state", lambda value: 0 if value is None else value)
        self.inputs, self.outputs = 0, 1
        self.model: BaseEstimator | None = None
        self._kept: Tensor | None = torch.empty(0, dtype=torch.uint8)

    def fresh(self, inputs: int, outputs: int) -> Sklearn:
        """One that has not learned and predicts 0.

        Raises:
            ValueError: if the regressor predicts one number only, and more are wanted.
        """
        if outputs > 1 and not get_tags(self.estimator).target_tags.multi_output:
            raise ValueError(
                f"{self.estimator!r} predicts one number, but an action has {outputs} here; "
                "put it into sklearn.multioutput.MultiOutputRegressor"
            )
        made = Sklearn(self.estimator)
        made.inputs, made.outputs = inputs, outputs
        return made

    def fit(self, x: Tensor, y: Tensor) -> None:
        """Forget everything and learn y [N, outputs] from x [N, inputs]."""
        single = self.outputs == 1 and get_tags(self.estimator).target_tags.single_output
        # In double precision, or least squares lose digits.
        numbers = [data.cpu().double().numpy() for data in (x, y.squeeze(-1) if single else y)]
        # Threads take longer to start than a small batch takes, and they add up in any order.
        self.model = _with(clone(self.estimator).fit(*numbers), "n_jobs", lambda _: 1)
        self._kept = None

    def forward(self, x: Tensor) -> Tensor:
        """[*batch, inputs] to [*batch, outputs]."""
        if self.model is None:
            return x.new_zeros(*x.shape[:-1], self.outputs)
        y = _predict(self.model, x.detach().reshape(-1, x.shape[-1]).cpu().numpy())
        return torch.from_numpy(np.asarray(y, np.float32)).to(x).reshape(*x.shape[:-1], self.outputs)

    def get_extra_state(self) -> Tensor:
        """The fitted regressor as bytes, [bytes] uint8; none before the first fit.

        Raises:
            UserError: if it has parts that could not be read back.
        """
        if self._kept is None:
            self._kept = torch.frombuffer(bytearray(_archive(self.model)), dtype=torch.uint8)
        return self._kept

    def set_extra_state(self, state: Tensor) -> None:
        """Take over a fitted regressor.

        Raises:
            UserError: if it has parts of types that are not trusted, is none at all, or reads other data.
        """
        kept = state.cpu()
        model = _read(kept.numpy().tobytes()) if len(kept) else None
        reads = getattr(model, "n_features_in_", self.inputs)
        if reads != self.inputs:
            raise UserError(f"the state holds a regressor that reads {reads} numbers, but {self.inputs} are observed")
        self.model, self._kept = model, kept


def _predict(model: BaseEstimator, x: Array) -> Array:
    """What a model predicts for x [N, inputs]; of a small batch, a forest's own checks would take most of the time."""
    rows = np.asarray(x, np.float32)
    # A tree checks nothing itself; scikit-learn says what is wrong with rows that are not as these.
    if type(model) in FORESTS and rows.shape[1] == model.n_features_in_ and np.isfinite(rows).all():
        return sum(tree.tree_.predict(rows) for tree in model.estimators_) / len(model.estimators_)
    return model.predict(x)


def _with(estimator: BaseEstimator, name: str, value: Callable[[object], object]) -> BaseEstimator:
    """The estimator after it, and the ones inside it, got other values of a parameter."""
    found = {key: given for key, given in estimator.get_params().items() if key.split("__")[-1] == name}
    return estimator.set_params(**{key: value(given) for key, given in found.items()})


def _archive(model: BaseEstimator) -> bytes:
    """What skops makes of a model, but the same for the same model.

    skops names each part by the address at which it lies in memory, and a zip archive tells the time. Here the parts
    are counted, and it is always 1980.
    """
    numbers: dict[str, str] = {}

    def count(address: re.Match[str]) -> str:
        return numbers.setdefault(address[0], str(len(numbers)))

    content = io.BytesIO()
    with (
        ZipFile(io.BytesIO(skops.io.dumps(model))) as given,
        ZipFile(content, "w", compression=ZIP_DEFLATED, compresslevel=1) as kept,
    ):
        schema = re.sub(r'(?<="__id__": )\d+|(?<="file": ")\d+', count, given.read("schema.json").decode())
        kept.writestr(_undated("schema.json"), schema)
        for name in given.namelist():
            if name != "schema.json":
                kept.writestr(_undated(re.sub(r"^\d+", count, name)), given.read(name))
    _check(content.getvalue())
    return content.getvalue()


def _undated(name: str) -> ZipInfo:
    entry = ZipInfo(name)
    entry.compress_type = ZIP_DEFLATED
    return entry


def _read(content: bytes) -> BaseEstimator:
    try:
        _check(content)
        model = skops.io.loads(content, trusted=list(TRUSTED))
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"the state holds no regressor that scikit-learn can read ({type(error).__name__}); train again"
        ) from error
    if not isinstance(model, BaseEstimator) or not is_regressor(model):
        raise UserError(f"the state holds a {type(model).__name__}, but a regressor is wanted; train again")
    return model


def _check(content: bytes) -> None:
    unknown = sorted(set(skops.io.get_untrusted_types(data=content)) - set(TRUSTED))
    if unknown:
        raise UserError(
            f"a regressor with parts of type {', '.join(unknown)} is neither kept nor read, for they could run code; "
            "use another regressor"
        )
