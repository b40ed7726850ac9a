from functools import partial

import pytest
import torch

from coil_rl import compiled
from coil_rl.compiled import Compiled
from coil_rl.errors import UserError


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def walk(position, step, bias=2.0):
    """Move by a noisy step in place; return the distance and a random number."""
    noise = torch.randn_like(position)
    position.add_(step.tanh() * noise + bias)
    return position.norm(), torch.rand(3)


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A cache with the compiled code of `walk` for 4 numbers."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        Compiled(walk)(torch.ones(4), torch.ones(4))
    return folder


@pytest.mark.slow
def test_compiled_function_has_the_results_the_changes_and_the_random_numbers_of_the_function(
    walked, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(walked))
    function = Compiled(walk)
    found, expected = torch.ones(4), torch.ones(4)
    for seed in range(3):
        step = torch.linspace(-1, seed, 4)
        torch.manual_seed(seed)
        distance, drawn = function(found, step)
        torch.manual_seed(seed)
        reference = walk(expected, step)
        torch.testing.assert_close([distance, drawn, found], [*reference, expected])


@pytest.mark.slow
def test_code_is_found_by_the_operations_and_the_shapes_and_constants(walked, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(walked))
    made = []
    monkeypatch.setattr(compiled, "compile_graph", lambda graph, arguments, path: made.append(path))
    before, *_ = sizes = (torch.zeros(4), torch.ones(4))
    Compiled(walk)(*sizes)
    assert not made  # from the disk
    assert before.abs().min() > 0
    for function, arguments in (
        (walk, (torch.ones(6), torch.ones(6))),
        (partial(walk, bias=3.0), sizes),
        (partial(walk, bias=torch.arange(4.0)), sizes),
        (partial(walk, bias=torch.arange(4.0) + 1), sizes),
    ):
        with pytest.raises(RuntimeError, match="cannot open shared object file"):
            Compiled(function)(*arguments)
    assert len(set(made)) == 4
    assert len(list((walked / "coil-rl").iterdir())) == 1


MASK = torch.tensor([True, False, True])


@pytest.mark.parametrize(
    ("function", "operation"),
    [
        (lambda x: [x[x.nonzero()[:, 0]]], "nonzero"),
        (lambda x: [x[x > 0].sum()], "index"),
        (lambda x: [x[MASK]], "index"),
    ],
)
def test_shapes_that_depend_on_values_are_refused(function, operation):
    with pytest.raises(UserError, match=rf"cannot be compiled, because aten\.{operation}"):
        Compiled(function)(torch.ones(3))


def test_entries_by_their_numbers_are_compiled():
    drawn, fixed = (lambda: torch.randperm(3)[:2].sort()[0]), torch.tensor([2, 0])
    graph = compiled.record(lambda x: [x[drawn()], x[:, fixed]], (torch.ones(3, 3),))
    rows, columns = graph(torch.arange(9.0).view(3, 3))
    assert rows.shape == (2, 3)
    assert columns.tolist() == [[2, 0], [5, 3], [8, 6]]


def test_constant_that_shares_memory_with_an_argument_is_refused():
    position = torch.ones(3)
    part = position[1:]
    with pytest.raises(UserError, match="shares its memory with another one"):
        Compiled(lambda x: [x.add_(1), part * 2])(position)


def test_code_is_compiled_again_for_another_number_of_threads(monkeypatch):
    graph, sizes = (
        compiled.record(walk, (torch.ones(4), torch.ones(4))),
        (torch.ones(4), torch.ones(4)),
    )
    one = compiled.fingerprint(graph, sizes)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    assert compiled.fingerprint(graph, sizes) != one


def test_place_that_cannot_be_made_is_named(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(
        UserError,
        match=r"file/coil-rl cannot be made for compiled code \(Not a directory\); set XDG_",
    ):
        Compiled(lambda x: [x.sin()])(torch.ones(3))


def test_missing_compiler_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("CXX", "missing")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        UserError, match=r"without a C\+\+ compiler; install one, or take compile=false"
    ):
        Compiled(lambda x: [x.sin()])(torch.ones(3))
    assert not list((tmp_path / "coil-rl").iterdir())


def test_function_of_tensors_on_a_gpu_is_refused():
    # No memory is behind this device, and no GPU is needed for it.
    with pytest.raises(UserError, match="on a GPU take compile=false"):
        Compiled(walk)(torch.ones(4, device="meta"), torch.ones(4, device="meta"))
