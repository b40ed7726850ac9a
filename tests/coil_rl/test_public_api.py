import subprocess
import sys

import coil_rl


def test_every_public_name_is_importable_and_listed():
    assert coil_rl.__all__ == sorted(set(coil_rl.__all__))
    assert set(coil_rl.__all__) <= set(dir(coil_rl))
    for name in coil_rl.__all__:
        part = getattr(coil_rl, name)
        assert part.__name__ == name
        assert part.__doc__
    assert not hasattr(coil_rl, "Nothing")


def test_import_of_the_package_is_light():
    script = (
        "import sys, coil_rl; assert not {'torch', 'hydra'} & set(sys.modules); "
        "from coil_rl import UserError"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
