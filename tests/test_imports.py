import ast
import functools
import graphlib
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import coil_rl
import coil_rl.for_guests

ROOT = Path(__file__).resolve().parents[1]
LINKED = {
    "envs": "coil_rl.envs",
    "transforms": "coil_rl.transforms",
    "conf": "coil_rl.conf",
    "fmu": "coil_fmu",
    "paper": "coil_paper",
    "studies": "coil_studies",
    "robot": "coil_robot",
}
TENSOR_LIBRARIES = {"torch", "tensordict", "torchrl"}

# Packages whose `__init__.py` says what is public: `from coil_rl.envs import Track as Track`.
PUBLIC = [
    "coil_fmu",
    "coil_rl.cones",
    "coil_rl.envs",
    "coil_rl.envs.recordings",
    "coil_rl.envs.robot",
    "coil_rl.export",
    "coil_rl.guides",
    "coil_rl.imitation",
    "coil_rl.learners",
    "coil_rl.report",
    "coil_rl.transforms",
    "coil_robot",
    "coil_studies",
    "coil_studies.listening",
]

# Public modules of theirs, with all that they hold.
MODULES = [
    "coil_rl.envs.recordings.bearings",
    "coil_rl.envs.recordings.mcap_files",
    "coil_rl.envs.recordings.messages",
    "coil_rl.envs.robot.clusters",
    "coil_rl.ranges",
]

# Folder -> allowed imports besides the standard library and the folder itself.
ALLOWED = {
    "transforms": TENSOR_LIBRARIES,
    "envs": TENSOR_LIBRARIES
    | {"numpy", "scipy", "mcap", "lz4", "zstandard", "rosbags", "gymnasium"},
    "conf": set(),
}
# What everything may import.
BELOW = tuple(
    f"coil_rl.{name}" for name in ("errors", "extras", "files", "lazy", "plain_yaml", "ranges")
)


def source_files(*folders: str) -> list[Path]:
    # The links coil_rl/envs, ... are searched under their own name.
    linked = [ROOT / name.replace(".", "/") for name in LINKED.values()]
    found = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return sorted(path for path in found if not any(path.is_relative_to(link) for link in linked))


def package_of(path: Path) -> list[str]:
    """Return the package of a file: envs/robot/bag.py -> coil_rl, envs, robot."""
    folder, *rest = path.relative_to(ROOT).parent.parts
    return [*LINKED.get(folder, folder).split("."), *rest]


@functools.cache
def imported_modules(path: Path) -> list[str]:
    """Return the absolute names of all imported modules of a file."""
    return list(modules_of(ast.parse(path.read_text(encoding="utf-8")), path))


def modules_of(tree: ast.Module, path: Path) -> Iterator[str]:
    """Yield the absolute names of the imported modules of a tree.

    `from a import b` gives `a.b`, because b may be a module.
    """
    package = package_of(path)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*start, *filter(None, [node.module])])
            yield from (f"{stem}.{alias.name}" for alias in node.names)


def is_inside(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def forbidden_imports(path: Path, folder: str) -> list[str]:
    """Return the imports of a file that are not allowed in its folder."""
    libraries = ALLOWED[folder] | sys.stdlib_module_names
    return [
        module
        for module in imported_modules(path)
        if module.split(".")[0] not in libraries
        and not is_inside(module, LINKED[folder])
        and not any(is_inside(module, each) for each in BELOW)
    ]


@pytest.mark.parametrize("folder", ALLOWED)
def test_folder_imports_only_what_the_design_allows(folder: str) -> None:
    wrong = {}
    for path in source_files(folder):
        bad = forbidden_imports(path, folder)
        if bad:
            wrong[str(path.relative_to(ROOT))] = bad
    assert not wrong, (
        f"{folder}/ may import only {sorted(ALLOWED[folder])}, the standard library and itself"
    )


def public_names():
    """Return the full names of everything public in coil_rl."""
    names = {*PUBLIC, *(f"coil_rl.{name}" for name in coil_rl.__all__)}
    names |= {f"coil_rl.for_guests.{name}" for name in coil_rl.for_guests.__all__}
    names.add("coil_rl.for_guests.lazy_names")
    for package in PUBLIC:
        init = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text("utf-8"))
        imports = [node for node in ast.walk(init) if isinstance(node, ast.ImportFrom)]
        aliases = [alias for node in imports for alias in node.names]
        names |= {f"{package}.{alias.asname}" for alias in aliases if alias.asname == alias.name}
    return names


@pytest.mark.parametrize("guest", ["fmu", "paper", "robot"])
def test_guest_imports_only_what_is_public(guest: str) -> None:
    public = public_names()
    own = (LINKED[guest], *MODULES)
    wrong = [
        f"{path.relative_to(ROOT)}: {module}"
        for path in source_files(guest)
        for module in imported_modules(path)
        if module.startswith("coil_") and module not in public
        if not any(is_inside(module, each) for each in own)
    ]
    assert not wrong, "a guest is written as a stranger's package; use, or make, public names"


@pytest.mark.parametrize("guest", ["coil_fmu", "coil_paper", "coil_robot", "coil_studies"])
def test_library_does_not_name_its_guests(guest: str) -> None:
    folders = ["coil_rl", "envs", "transforms", "conf"]
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    texts = [path for path in files if path.suffix in (".py", ".yaml")]
    texts = [path for path in texts if path.name != "cone_track.yaml"]  # coil-listen's sections
    table = re.compile(r"^OLD_NAMES = {.*?^}", re.DOTALL | re.MULTILINE)  # of older run folders
    assert [str(path) for path in texts if guest in table.sub("", path.read_text("utf-8"))] == []


def test_only_modules_of_that_name_import_gymnasium() -> None:
    found = {path.stem: imported_modules(path) for path in source_files("envs")}
    users = [
        stem for stem, names in found.items() if any(is_inside(name, "gymnasium") for name in names)
    ]
    assert users == ["gym"]
    assert not [
        stem
        for stem, names in found.items()
        if any(is_inside(name, "coil_rl.envs.gym") for name in names)
    ]


@pytest.mark.parametrize("folder", ["coil_rl", "tests", *LINKED])
def test_folders_are_not_imported_by_their_bare_names(folder: str) -> None:
    # `import envs` would load a second copy of the package, with classes that are not the first
    # one's.
    wrong = []
    for path in source_files(folder):
        for module in imported_modules(path):
            if module.split(".")[0] in LINKED:
                wrong.append(f"{path.relative_to(ROOT)}: {module}")
    assert not wrong, f"write {', '.join(LINKED.values())}"


def test_package_list_matches_the_folders() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    folders = {".".join(package_of(path)) for path in source_files("coil_rl", *LINKED)}
    assert sorted(tools["setuptools"]["packages"]) == sorted(folders)


def test_every_folder_with_python_files_is_a_package() -> None:
    # A forgotten __init__.py works in the checkout and is missing from the wheel.
    folders = {path.parent for path in source_files("coil_rl", *LINKED)}
    assert [
        str(path.relative_to(ROOT)) for path in folders if not (path / "__init__.py").is_file()
    ] == []


class WithoutTypes(ast.NodeTransformer):
    """Leaves out what is imported for type checkers only."""

    def visit_If(self, node: ast.If) -> list[ast.stmt] | ast.If:
        return node.orelse if ast.unparse(node.test) == "TYPE_CHECKING" else node


def test_no_files_import_each_other() -> None:
    files = source_files("coil_rl", *LINKED)
    modules = {path: ".".join([*package_of(path), path.stem]) for path in files}
    modules = {path: name.removesuffix(".__init__") for path, name in modules.items()}
    graph, known = {}, {*modules.values()}
    for path, module in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found = modules_of(WithoutTypes().visit(tree), path)
        names = {name if name in known else name.rpartition(".")[0] for name in found}
        graph[module] = names - {module}
    graphlib.TopologicalSorter(graph).prepare()  # a circle is a CycleError
