"""YAML files of a user: what they lack is said, with the name of the file."""

import pytest
from programs import called

FILES = {
    "method/a": ("# @package _global_\nmethod: {observes: []}", "name into method/a.yaml"),
    "method/b": ("method: {name: b, observes: []}", "method/b.yaml: Hydra puts its keys under"),
    "method/c": (
        "# @package _global_\nmethod: {name: c, transform: {}}",
        "method/c.yaml: method has no key transform; it has name, observes, transforms, "
        "needs_guide, learner, run; did you mean transforms?",
    ),
    "method/d": ("# @package _global_\nmethod: {name: d}", "observes into method/d.yaml"),
    "method/f": (
        "# @package _global_\ndefaults: [ppo]\nlearner: {anchr: null}",
        "method/f.yaml: learner: PPO takes no anchr; it takes ",
    ),
    "experiment/e": (
        "defaults: [override /env: pendulum]",
        "experiment/e.yaml: begin the file with the line # @package _global_",
    ),
}


@pytest.mark.fast(2)
@pytest.mark.parametrize("file", FILES)
def test_mistake_in_a_file_of_the_user_names_the_file(file, tmp_path):
    text, said = FILES[file]
    group, name = file.split("/")
    (tmp_path / group).mkdir()
    (tmp_path / group / f"{name}.yaml").write_text(text)
    chosen = f"+{group}={name}" if group == "experiment" else f"{group}={name}"
    done = called("train", "--config-dir", str(tmp_path), chosen, cwd=tmp_path, code=2)
    assert done.stderr.startswith("train: ")
    assert said in done.stderr


def test_key_of_a_swept_file_says_how_to_write_it(tmp_path):
    words = ["-m", "env=pendulum,cart_pole", "env.workers=0", "seed=0,1"]
    done = called("train", *words, cwd=tmp_path, code=2)
    assert "write env.workers=choice(VALUE)" in done.stderr
