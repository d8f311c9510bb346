"""Makes the bundled maps from their source packages.

    python -m unirender_reference.lights.convert SOURCE

reads `SOURCE/pmndrs/*.exr` (npm `@pmndrs/assets` 1.7.0) and `SOURCE/blender/*.exr` (Debian `blender-data`), and writes
the resized maps and `lights.toml` (with the sha256 of every source file) into `data/lights`. Source files that differ
from the sha256 in the present catalogue are refused.

Split: maps whose name occurs in both packages may show the same place and stay on one side. (By content, see `twins`:
`sunrise` is the same capture.)
"""

import argparse
import hashlib
import tomllib
from pathlib import Path

import numpy as np

from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, image_channels, read_exr, write_exr
from unirender_reference.lights.bundled import data_folder
from unirender_reference.lights.light import SHAPE, area_resampled, normalized

TEST = {
    *("pmndrs-city", "blender-city", "pmndrs-sunset", "blender-sunset"),
    *("pmndrs-lobby", "pmndrs-workshop", "blender-courtyard", "blender-interior"),
}
PACKAGES = {"pmndrs": "npm @pmndrs/assets 1.7.0", "blender": "Debian blender-data"}


def convert(source: Path, target: Path) -> None:
    """Resizes the source maps to 64 x 128 half EXR and writes the catalogue; equal sources give equal bytes.

    Raises:
        UnirenderError: a source file is missing or is not the one in the present catalogue.
    """
    sources = {}
    for package, title in PACKAGES.items():
        files = sorted((source / package).glob("*.exr"))
        if not files:
            raise UnirenderError(f"{source / package}: no EXR files; expected the maps of {title}")
        sources |= {f"{package}-{file.stem}": (package, file) for file in files}
    digests = {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, (_, file) in sources.items()}
    if (target / "lights.toml").is_file():
        known = tomllib.loads((target / "lights.toml").read_text(encoding="utf-8"))
        for name in sorted(known.keys() | digests.keys()):
            expected, got = known.get(name, {}).get("source_sha256", "no such map"), digests.get(name, "no file")
            if got != expected:
                raise UnirenderError(f"{name}: got sha256 {got}, expected {expected}; use the stated packages")
    lines = ["# Written by `python -m unirender_reference.lights.convert SOURCE`; licences are in LICENSES.txt.\n"]
    for name, (package, file) in sources.items():
        channels, _ = read_exr(file)
        environment = normalized(np.maximum(area_resampled(channels_rgb(channels), SHAPE), 0), name)
        write_exr(target / f"{name}.exr", image_channels(environment), half=True)
        row = {
            "file": f"{name}.exr",
            "source": f"{package}/{file.name}",
            "package": PACKAGES[package],
            "license": "CC0-1.0",
            "split": "test" if name in TEST else "train",
            "source_sha256": digests[name],
        }
        lines += [f"[{name}]", *[f'{key} = "{value}"' for key, value in row.items()], ""]
    (target / "lights.toml").write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Remake the bundled lights.")
    parser.add_argument("source", type=Path, help="folder with pmndrs/ and blender/")
    parser.add_argument(
        "--target", type=Path, default=Path(str(data_folder())), help="default: the package's data/lights"
    )
    arguments = parser.parse_args()
    convert(arguments.source, arguments.target)
