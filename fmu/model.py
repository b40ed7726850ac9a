"""An FMU: what its modelDescription.xml says, and instances of it that are co-simulated.

The file is unpacked once for a process and its forks. FMI 2 and 3 differ in the names of their
types and in the beginning of a simulation; all of that is here.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coil_rl import did_you_mean
from coil_rl.for_guests import require

if TYPE_CHECKING:
    from fmpy.model_description import ModelVariable

REAL = ("Real", "Float32", "Float64")
NO_NUMBERS = ("String", "Binary", "Clock")
WARNING, FATAL = 1, 4  # states of the calls of FMI
# What is logged of an FMU that has these categories; of another one what it logs of its own accord.
LOGGED = ("logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal")

Floats = NDArray[np.float64]


class SolverError(Exception):
    """What an FMU says when it cannot go on with its simulation."""


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU.

    Attributes:
        name: as the FMU has it.
        type: of FMI, such as "Real" or "Float64".
        call: its type in the calls of FMI, where an Enumeration is a whole number.
        low: smallest value, infinite if it says none; of the choices of an Enumeration the first.
        high: largest value.
        unit: as a text; empty for none.
        meaning: its description, with its nominal value.
        shape: of an array; empty for a single value.
        own: the variable of FMPy.
    """

    name: str
    type: str
    call: str
    low: float
    high: float
    unit: str
    meaning: str
    shape: tuple[int, ...]
    own: ModelVariable

    @property
    def size(self) -> int:
        """Number of values."""
        return math.prod(self.shape)


def _variable(own: ModelVariable, version: str) -> Variable:
    """Return a variable as the description of an FMU has it, or its declared type."""
    declared = own.declaredType

    def said(name: str) -> Any:
        return getattr(own, name) or getattr(declared, name, None)

    low, high = said("min"), said("max")
    if own.type == "Boolean":
        low, high = 0, 1
    elif own.type == "Enumeration" and declared is not None:
        numbers = [int(item.value) for item in declared.items]
        low, high = min(numbers), max(numbers)
    whole = "Integer" if version.startswith("2") else "Int64"
    nominal = f"nominal {said('nominal')}" if said("nominal") else ""
    return Variable(
        own.name,
        own.type,
        whole if own.type == "Enumeration" else own.type,
        -math.inf if low is None else float(low),
        math.inf if high is None else float(high),
        said("unit") or "",
        ", ".join(filter(None, (own.description, nominal))),
        tuple(own.shape or ()),
        own,
    )


class Model:
    """An FMU for co-simulation that runs on this machine.

    Args:
        file: the FMU.

    Attributes:
        variables: by name.
        name: of the file, for messages.
        folder: where it is unpacked, until this process ends.
        single: whether a process may hold only one instance of each copy of it.

    Raises:
        ValueError: for a file that is none, of FMI 1, not for co-simulation, or for another
            platform.
    """

    def __init__(self, file: str | os.PathLike[str]) -> None:
        require("an FMU", "fmu", "fmpy")
        import fmpy

        self.description: Any = None
        self.file = os.fspath(file)
        path = Path(file).expanduser()
        if not path.is_file():
            raise ValueError(f"file={self.file} does not exist")
        try:
            with zipfile.ZipFile(path) as archive:
                names, text = archive.namelist(), archive.read("modelDescription.xml")
            old = re.search(rb"fmiVersion=[\"']1", text)  # is read in another way
            self.description = None if old else fmpy.read_model_description(path, validate=False)
        except Exception as error:  # of XML, of ZIP, and plain ones of FMPy
            raise ValueError(f"file={self.file} is no FMU: {str(error).splitlines()[0]}") from error
        if old:
            raise ValueError(
                f"file={self.file} is of FMI 1, but FMI 2 and 3 are read; export it again"
            )
        self._check(names)
        self.variables = {
            own.name: _variable(own, self.description.fmiVersion)
            for own in self.description.modelVariables
        }
        self.path, self.name, self.said = path, path.name, set[str]()
        self.single = self.description.coSimulation.canBeInstantiatedOnlyOncePerProcess
        self.folder = self.unpacked()

    def _check(self, names: Iterable[str]) -> None:
        """Raise a `ValueError` for an FMU that this program cannot simulate."""
        import fmpy

        if self.description.coSimulation is None:
            kind = "model exchange" if self.description.modelExchange else "scheduled execution"
            raise ValueError(f"file={self.file} is for {kind} only; export it for co-simulation")
        places = [name.split("/")[1] for name in names if name.startswith("binaries/")]
        if not {fmpy.platform, fmpy.platform_tuple} & set(places):
            found = ", ".join(sorted(set(filter(None, places)))) or "no platform"
            raise ValueError(
                f"file={self.file} has binaries for {found}, but this is {fmpy.platform}; export "
                "it here, or compile its sources (python -m fmpy compile)"
            )

    def unpacked(self) -> str:
        """Unpack the FMU into a new folder, which is removed when this model or process ends."""
        import fmpy

        folder: str = fmpy.extract(self.path, tempfile.mkdtemp(prefix="fmu_")).__fspath__()
        weakref.finalize(self, _remove, folder, os.getpid())
        return folder

    def of(self, *causalities: str) -> list[Variable]:
        """Return the variables of some causalities, in the order of the FMU."""
        found = self.variables.values()
        return [each for each in found if each.own.causality in causalities]

    def named(self, key: str, names: Iterable[str], *causalities: str) -> list[Variable]:
        """Return variables by their names.

        Args:
            key: of the argument that names them, for the message.
            names: of the variables.
            causalities: which they may have.

        Raises:
            ValueError: for a name that is none of them.
        """
        known = {each.name: each for each in self.of(*causalities)}
        for name in names:
            if name not in known:
                raise ValueError(
                    f"{key}: {self.name} has no {' or '.join(causalities)} {name!r}; it has "
                    f"{', '.join(list(known)[:20]) or 'none'}{did_you_mean(name, known)}"
                )
        return [known[name] for name in names]

    def experiment(self, name: str) -> float | None:
        """Return a number of its DefaultExperiment, None if it says none."""
        value = getattr(self.description.defaultExperiment, name, None)
        return None if value is None else float(value)


def _remove(folder: str, process: int) -> None:
    if os.getpid() == process:  # forks share the folder
        shutil.rmtree(folder, ignore_errors=True)


class Instance:
    """A running copy of an FMU.

    Args:
        model: the FMU.
        outputs: variables that are read, numbers only.
    """

    def __init__(self, model: Model, outputs: Sequence[Variable]) -> None:
        self.model, self.outputs = model, list(outputs)
        self.fmu: Any = None
        self.messages: list[str] = []  # of the simulation: warnings and worse
        calls = dict.fromkeys(each.call for each in outputs)
        self.groups = {call: [each for each in outputs if each.call == call] for call in calls}
        self.folder = model.unpacked() if model.single else model.folder

    def begin(self, start: float, values: Mapping[str, Any]) -> None:
        """Begin a simulation.

        Args:
            start: time, in s.
            values: of parameters, inputs and start values, by name.

        Raises:
            SolverError: for what the FMU refuses.
        """
        import fmpy

        self.messages.clear()
        with _calls(self):
            if self.fmu is None:
                self.fmu = fmpy.instantiate_fmu(
                    self.folder,
                    self.model.description,
                    "CoSimulation",
                    logger=partial(_logged, self.messages),
                )
                self._log_failures()
            else:
                self.fmu.reset()
            self._initialise(start, dict(values))

    def _log_failures(self) -> None:
        """Let an FMU say why it fails; without a category it would say everything."""
        declared = {each.name for each in self.model.description.logCategories}
        if categories := [name for name in LOGGED if name in declared]:
            with suppress(Exception):  # one that cannot still simulates
                self.fmu.setDebugLogging(True, categories)

    def _initialise(self, start: float, values: dict[str, Any]) -> None:
        from fmpy.simulation import (
            apply_start_values,
            settable_in_initialization_mode,
            settable_in_instantiated,
        )

        apply = partial(apply_start_values, self.fmu, self.model.description)
        begin: dict[str, float] = {"startTime": start}
        if self.model.description.fmiVersion.startswith("2"):
            self.fmu.setupExperiment(**begin)
            begin = {}
        left = apply(values, settable=settable_in_instantiated)
        self.fmu.enterInitializationMode(**begin)
        left = apply(left, settable=settable_in_initialization_mode)
        self.fmu.exitInitializationMode()
        if left:
            raise SolverError(f"{', '.join(left)} cannot be set before a simulation")

    def write(self, variable: Variable, values: Sequence[float]) -> None:
        """Set an input, a `SolverError` if the FMU refuses it."""
        kind = variable.own._python_type
        with _calls(self):
            setter = getattr(self.fmu, f"set{variable.call}")
            setter([variable.own.valueReference], [kind(value) for value in values])

    def read(self) -> dict[str, Floats]:
        """Return the values of the outputs; a `SolverError` for one that is not finite."""
        found: dict[str, Floats] = {}
        arrays = self.model.description.fmiVersion.startswith("3")
        with _calls(self):
            for call, variables in self.groups.items():
                references = [each.own.valueReference for each in variables]
                getter, sizes = getattr(self.fmu, f"get{call}"), [each.size for each in variables]
                given = getter(references, sum(sizes)) if arrays else getter(references)
                parts = np.split(np.array(given, dtype=np.float64), np.cumsum(sizes)[:-1])
                for variable, part in zip(variables, parts, strict=True):
                    found[variable.name] = part.reshape(variable.shape or (1,))
        for name, value in found.items():
            if not np.isfinite(value).all():
                raise SolverError(f"its output {name} is {value.tolist()}")
        return found

    def advance(self, time: float, step: float) -> None:
        """Simulate a step; a `SolverError` if the FMU cannot, or wants to end.

        Args:
            time: of the begin of the step, in s.
            step: its length, in s.
        """
        with _calls(self):
            answer = self.fmu.doStep(time, step)
        if answer is not None and answer[1]:
            raise SolverError("it asks to end the simulation")

    def close(self) -> None:
        """Free the instance."""
        fmu, self.fmu = self.fmu, None
        if fmu is not None:
            fmu.freeInstance()


class _calls:  # noqa: N801  a context, as small as it can be: it is around each call
    """Turn what FMPy raises into a `SolverError`, after which the instance is not used again."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is None or not isinstance(error, Exception):
            return
        instance, said = self.instance, self.instance.messages
        if getattr(error, "status", None) == FATAL:
            instance.fmu = None  # nothing may be called any more, not even to free it
        else:
            instance.close()
        reason = str(error).rstrip(".")
        raise SolverError(f"{said[-1]} ({reason})" if said else reason) from error


def _logged(messages: list[str], *given: Any) -> None:
    """Keep a message of an FMU that is a warning or worse.

    Args:
        given: what FMI 2 or 3 gives: its last three are status, category and text.
    """
    status, _, text = given[-3:]
    if status >= WARNING and text:
        messages.append(" ".join(text.decode("utf-8", "replace").split()))
