"""The program `unirender` with a preset more, `test`: a network that trains in seconds. For processes of their own."""

from tiny_models import TRAIN

from unirender import cli
from unirender.training.presets import PRESETS

if __name__ == "__main__":
    PRESETS["test"] = TRAIN
    cli.main()
