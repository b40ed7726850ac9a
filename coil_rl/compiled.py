"""Machine code for functions of tensors, compiled once and kept on disk.

With small networks and few cars the calls of single operations take longer than their arithmetic.
Here a function is recorded as one graph of operations, which TorchInductor compiles ahead of time
to a library. The library is kept under a name made from the graph, so that later processes load it
within milliseconds and need no compiler.
"""

import hashlib
import platform
import shutil
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.fx import GraphModule, Node

from coil_rl.envs.kept_tables import cache_folder
from coil_rl.errors import UserError
from coil_rl.files import whole_file
from coil_rl.output import say

# Random numbers come from PyTorch's generators, as without compilation; tanh from exp, which is
# twice as fast.
OPTIONS = {"fallback_random": True, "cpp.use_decompose_tanh": True}
# Operations whose result has a shape that depends on values.
DYNAMIC = torch.Tag.dynamic_output_shape
MASKS = (torch.bool, torch.uint8)  # types of an index that is a mask
MASK = "mask"  # entry of a node's meta: whether an index by its value is a mask


class Compiled:
    """A function of tensors that is compiled at its first call, and again for other shapes.

    The results differ from those of the function in the last digits.

    Args:
        function: takes tensors and returns tensors. It may change its arguments in place. Every
            tensor that it reads and that changes between calls must be among the arguments. It is
            run once for each set of shapes; after that only its operations on tensors are repeated,
            so Python's decisions are those of that run.
        once: whether to compile it for the shapes of the first call only, and to run it as it is
            for others.

    Raises:
        UserError: at a call, if a tensor is on a GPU, if there is no C++ compiler or no place for
            the library, or if the shape of a tensor depends on values.
    """

    def __init__(self, function: Callable[..., Sequence[Tensor]], once: bool = False) -> None:
        self.function, self.once = function, once
        self.shapes: set[tuple[torch.Size, ...]] = set()
        self.libraries: dict[tuple[Any, ...], Any] = {}

    def __call__(self, *arguments: Tensor) -> Sequence[Tensor]:
        """Return the results of the function."""
        layout = tuple(
            (argument.shape, argument.stride(), argument.dtype) for argument in arguments
        )
        if layout not in self.libraries:
            shapes = tuple(argument.shape for argument in arguments)
            if self.once and self.shapes and shapes not in self.shapes:
                return self.function(*arguments)
            self.libraries[layout] = library(self.function, arguments)
            self.shapes.add(shapes)
        results: list[Tensor] = self.libraries[layout].run(list(arguments))
        return results


def library(function: Callable[..., Sequence[Tensor]], arguments: Sequence[Tensor]) -> Any:
    """Return the loaded library of a function; compile it unless it is on disk.

    Args:
        function: of tensors, see `Compiled`.
        arguments: of the shapes for which the library is needed; they keep their values.

    Raises:
        UserError: see `Compiled`.
    """
    if any(argument.device.type != "cpu" for argument in arguments):
        raise UserError("code is compiled for the CPU only; on a GPU take compile=false")
    graph = record(function, arguments)
    path = cache_folder() / f"{fingerprint(graph, arguments)}.so"
    if not path.is_file():
        compile_graph(graph, arguments, path)
    return torch._C._aoti.AOTIModelContainerRunnerCpu(str(path), 1)


def compile_steps(env: nn.Module) -> None:
    """Compile the steps of an env, and those of its guides, where they can be.

    A part that can has a method `compile_steps`, which gets this module's `Compiled`.
    """
    for module in env.modules():
        compile_part = getattr(module, "compile_steps", None)
        if compile_part is not None:
            compile_part(Compiled)


def record(function: Callable[..., Sequence[Tensor]], arguments: Sequence[Tensor]) -> GraphModule:
    """Run a function and return the graph of its operations.

    Args:
        function: of tensors, see `Compiled`.
        arguments: with which the function is run; they keep their values.

    Raises:
        UserError: if the shape of a tensor depends on values.
    """
    from torch.fx.experimental import proxy_tensor  # takes half a second to import

    before = [argument.detach().clone() for argument in arguments]
    set_meta = proxy_tensor.set_meta

    # Shapes of the nodes take two thirds of the time of recording, and the compiler finds them
    # again.
    def set_meta_without_shapes(proxy: Any, value: Any) -> Any:
        if not isinstance(value, Tensor):
            return set_meta(proxy, value)
        proxy.node.meta[MASK] = value.dtype in MASKS
        return proxy

    without_shapes = patch.object(proxy_tensor, "set_meta", set_meta_without_shapes)
    compiling = patch.object(torch.compiler, "_is_compiling_flag", True)
    with compiling, without_shapes, torch.random.fork_rng(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Checks of values, as in TorchRL's distributions, are Python's decisions.
        record_calls = proxy_tensor.make_fx(
            lambda *tensors: function(*tensors), _error_on_data_dependent_ops=False
        )
        graph = record_calls(*arguments)
    with torch.no_grad():
        for argument, value in zip(arguments, before, strict=True):
            argument.copy_(value)
    graph.graph.eliminate_dead_code()
    _check_graph(graph, arguments)
    for node in graph.graph.nodes:
        node.meta.clear()
    graph.recompile()
    return graph


def _check_graph(graph: GraphModule, arguments: Sequence[Tensor]) -> None:
    """Raise a `UserError` if a graph would not compute what its function computes."""
    memory = {argument.untyped_storage().data_ptr() for argument in arguments}
    for constant in graph.buffers():
        # The graph would read a copy that no change of the argument reaches.
        if constant.untyped_storage().data_ptr() in memory:
            raise UserError(
                "this cannot be compiled, because it reads a tensor that shares its memory "
                "with another one"
            )
    for node in graph.graph.nodes:
        if DYNAMIC in getattr(node.target, "tags", ()) and not _by_numbers(graph, node):
            raise UserError(
                f"this cannot be compiled, because {node.target} gives shapes that depend on values"
            )


def _by_numbers(graph: GraphModule, node: Node) -> bool:
    """Return whether an operation picks entries by their numbers, which fixes the shape."""
    if node.target is not torch.ops.aten.index.Tensor:
        return False
    indices: Any = node.args[1]
    return not any(_is_mask(graph, index) for index in indices if index is not None)


def _is_mask(graph: GraphModule, index: Node) -> bool:
    if index.op == "get_attr":
        return getattr(graph, str(index.target)).dtype in MASKS
    return bool(index.meta.get(MASK, True))


def fingerprint(graph: GraphModule, arguments: Sequence[Tensor]) -> str:
    """Return a name for the compiled code of a graph on this machine.

    Args:
        arguments: of the shapes for which it is compiled.
    """
    parts: list[Any] = [graph.code, torch.__version__, torch.get_num_threads(), OPTIONS]
    # The code is for this processor.
    parts += [platform.node(), torch.backends.cpu.get_cpu_capability()]
    for argument in arguments:
        parts.append((argument.shape, argument.stride(), argument.dtype, argument.device))
    digest = hashlib.sha256(repr(parts).encode())
    for name, constant in sorted(graph.named_buffers()):
        digest.update(f"{name} {constant.dtype} {constant.shape}".encode())
        digest.update(constant.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]


def compile_graph(graph: GraphModule, arguments: Sequence[Tensor], path: Path) -> None:
    """Compile a graph to a library.

    Args:
        arguments: of the shapes for which it is compiled.

    Raises:
        UserError: if there is no C++ compiler or no place for the library.
    """
    import torch._inductor  # takes two seconds to import
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{path.parent} cannot be made for compiled code ({error.strerror}); "
            "set XDG_CACHE_HOME to another folder, or take compile=false"
        ) from error
    examples = tuple(argument.detach() for argument in arguments)
    try:
        get_cpp_compiler()  # otherwise a missing one is found out after most of the work
        say("compiling, once for these sizes and this machine (20 to 60 s) ...", error=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = torch._inductor.aot_compile(graph, examples, options=OPTIONS)
    except RuntimeError as error:
        if type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
            raise UserError(
                "this cannot be compiled without a C++ compiler; install one, or take compile=false"
            ) from error
        raise
    with whole_file(path) as unfinished:
        shutil.copyfile(str(made), unfinished)
