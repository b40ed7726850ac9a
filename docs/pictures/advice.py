"""Draw advice.png, the picture of the README: what a guide's advice gives where the view is noisy.

The runs are four seeds of each, which the report's own learning curves show:

    coil-train -m +experiment=advice_noisy_view method=coil,ppo seed=0,1,2,3 hydra.sweep.dir=FOLDER
    python docs/pictures/advice.py FOLDER
"""

import sys
from pathlib import Path

from PIL import Image

from coil_rl.report import draw_learning_curves, read_runs

NAMES = {
    "coil_intact": "with the guide's advice",
    "ppo_intact": "without advice",
}
COLOURS = 48  # of the file: a line needs few


def main() -> None:
    """Draw the curves of the runs in a folder, beside this file."""
    runs = read_runs([Path(sys.argv[1])])
    curves = {
        name: [run.curve for run in runs if run.label == label] for label, name in NAMES.items()
    }
    guide = next(value for run in runs for value in run.guide_returns.values())
    cases = int(runs[0].settings["evaluation"]["curve"]["num_envs"])
    file = Path(__file__).with_suffix(".png")
    draw_learning_curves(curves, file, guides={"the guide": guide}, cases=cases)
    with Image.open(file) as picture:
        picture.convert("RGB").quantize(COLOURS).save(file, optimize=True)


if __name__ == "__main__":
    main()
