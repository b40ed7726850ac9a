"""Help texts and wrong overrides import no heavy library, and help begins with examples."""

import json
import subprocess
import sys
import tomllib

import pytest
from programs import ROOT, environment, module

SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
PROGRAMS = sorted(script.removeprefix("coil-") for script in SCRIPTS)
HEAVY = {"torch", "torchrl", "tensordict", "sklearn", "matplotlib", "scipy", "pandas"}
# Several programs share one process, because importing Hydra takes most of the time.
SCRIPT = """
import contextlib, importlib, io, json, sys
results = []
for name, program, *arguments in json.loads(sys.argv[1]):
    sys.argv, code, out, error = [name, *arguments], 0, io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            importlib.import_module(program).main()
        except SystemExit as end:
            code = end.code
    results.append((code, out.getvalue(), error.getvalue(), list(sys.modules)))
print(json.dumps(results))
"""


def start(cwd, *commands):
    """Return exit code, standard output and error, and imported heavy modules of each command."""
    named = [[name, module(name), *arguments] for name, *arguments in commands]
    command = [sys.executable, "-c", SCRIPT, json.dumps(named)]
    done = subprocess.run(
        command, cwd=cwd, env=environment(cwd), capture_output=True, text=True, check=True
    )
    return [(*rest, HEAVY & set(modules)) for *rest, modules in json.loads(done.stdout)]


# Hydra takes more than a second for each help text.
@pytest.mark.slow
def test_help_begins_with_examples_and_imports_nothing_heavy(tmp_path):
    results = start(tmp_path, *([name, "--help"] for name in PROGRAMS))
    for name, (code, out, _, heavy) in zip(PROGRAMS, results, strict=True):
        assert (name, code, heavy) == (name, 0, set())
        assert out.startswith(f"coil-{name}: ")
        assert out.count(f"\n  coil-{name}") >= 2


@pytest.mark.slow
def test_wrong_override_is_refused_without_heavy_imports(tmp_path):
    commands = [[name, "seeed=1"] for name in PROGRAMS]
    commands += [["train", "learner=nope"], ["distill", "seed=abc"]]
    for command, (code, _, error, heavy) in zip(commands, start(tmp_path, *commands), strict=True):
        assert (command, code, heavy) == (command, 2, set())
        (sentence,) = error.splitlines()
        assert sentence.startswith(f"{command[0]}: ")
        assert command[1].partition("=")[0] in sentence
    assert not list(tmp_path.iterdir())


def printed(script, **variables):
    command, variables = [sys.executable, "-c", script], environment(ROOT) | variables
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.strip()


def test_programs_collect_garbage_from_the_start_but_seldom():
    """The env of a training that ended is garbage, and so is nothing of the imports."""
    script = (
        "import gc, sys\n"
        "sys.argv = ['coil-compare']\n"
        "import coil_rl.programs\n"
        "print(gc.isenabled(), gc.get_threshold()[0] >= 10_000)\n"
    )
    assert printed(script) == "True True"


@pytest.mark.slow
def test_training_imports_no_library_that_it_does_not_use():
    """Each of these takes half a second or more in every training, and is for something else."""
    script = (
        "import coil_rl.config.assemble, coil_rl.config.check, sys\n"
        "others = {'pandas', 'scipy.stats', 'scipy.interpolate', 'sklearn'}\n"
        "print(sorted(others & set(sys.modules)))\n"
    )
    assert printed(script) == "[]"


def test_info_prints_versions_and_imports_nothing_heavy(tmp_path):
    ((code, out, _, heavy),) = start(tmp_path, ["info"])
    assert (code, heavy) == (0, set())
    for name in ("python", "coil-rl", "torch ", "torchrl", "hydra-core", "commit"):
        assert name in out


BACKENDS = ["nonsense", "module://matplotlib_inline.backend_inline", "module://not.there", "tkagg"]


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_programs_draw_whatever_backend_the_environment_names(backend):
    # What every program does around its task, and what a task does to draw.
    script = (
        "from coil_rl.programs.app import program\n"
        "with program('train'):\n"
        "    from matplotlib import pyplot\n"
        "    pyplot.figure()\n"
        "    print(pyplot.get_backend().lower())\n"
    )
    assert printed(script, MPLBACKEND=backend) == "agg"


@pytest.mark.parametrize("order", ["coil_rl, torchrl", "torchrl, coil_rl"])
def test_log_of_torchrl_is_not_shown(order):
    script = f"import {order}\nfrom torchrl._utils import logger\n"
    script += "logger.info('Initialized a storage')\nlogger.warning('it is full')"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    said = done.stdout + done.stderr
    assert "Initialized a storage" not in said
    assert "it is full" in said
