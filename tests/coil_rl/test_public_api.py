import ast
import subprocess
import sys
from pathlib import Path

import coil_rl


def test_every_public_name_is_importable_and_listed():
    assert coil_rl.__all__ == sorted(set(coil_rl.__all__))
    assert set(coil_rl.__all__) <= set(dir(coil_rl))
    for name in coil_rl.__all__:
        part = getattr(coil_rl, name)
        assert part.__name__ == name
        assert part.__doc__
    assert not hasattr(coil_rl, "Nothing")


def test_type_checkers_see_the_same_names():
    (block,) = [
        node
        for node in ast.parse(Path(coil_rl.__file__).read_text()).body
        if isinstance(node, ast.If)
    ]
    names = {}
    for node in block.body:
        names |= {alias.asname: f"{node.module}.{alias.name}" for alias in node.names}
    assert names == {name: f"{coil_rl._MODULES[name]}.{name}" for name in coil_rl.__all__}


def test_import_of_the_package_is_light():
    script = (
        "import sys, coil_rl; assert not {'torch', 'hydra'} & set(sys.modules); "
        "from coil_rl import UserError"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
