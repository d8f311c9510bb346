"""The distribution as a stranger gets it: a wheel, installed in a clean environment, away from the checkout."""

import os
import re
import resource
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hatchling.builders.sdist import SdistBuilder
from PIL import Image

from unirender.exr import read_exr

ROOT = Path(__file__).resolve().parents[1]
MAX_WHEEL_MB = 95
MAX_SDIST_MB = 108  # of its files: they shrink by a tenth or more (weights do), and a package index takes 100
MAX_CHECKPOINT_MB = 80  # all of them
MAX_HELP_SECONDS = 0.7

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built by hatchling as pip would."""
    out = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)], cwd=ROOT, check=True)
    (path,) = out.glob("*.whl")
    return path


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a new virtual environment with the wheel in it.

    The dependencies are those of the running environment, seen through a .pth file (which does not follow the .pth
    files it leads to, so the editable checkout stays out of sight): nothing is downloaded.
    """
    folder = tmp_path_factory.mktemp("clean") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--quiet", str(wheel)], check=True)
    (site_packages,) = folder.glob("lib/python*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    where = run([str(python), "-c", "import unirender; print(unirender.__file__)"], folder).stdout
    assert str(folder) in where, f"imported from {where}, not from the wheel"
    return folder / "bin"


def run(command: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}}
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result


def test_the_wheel_holds_its_data_and_stays_small(wheel: Path) -> None:
    size_mb = wheel.stat().st_size / 1e6
    assert size_mb <= MAX_WHEEL_MB, f"{size_mb:.1f} MB, expected at most {MAX_WHEEL_MB}"
    with zipfile.ZipFile(wheel) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
    for pattern in (
        r"unirender/checkpoints/tiny/.*\.safetensors",
        r"unirender/checkpoints/tiny/.*config\.json",
        r"unirender/checkpoints/small/.*\.safetensors",
        r"unirender/checkpoints/small/.*config\.json",
        r"unirender/environment_brdf\.npy",
        r"unirender_reference/data/lights/.+",
        r"unirender_evaluation/data/lpips_alex\.safetensors",
        r"unirender_evaluation/data/suites/tiny\.toml",
        r"unirender_evaluation/data/suites/tiny\.tar",
        r"unirender_evaluation/.*published\.json",
        r"unirender_evaluation/.+\.(html|j2|jinja)",
        r"(unirender|unirender_reference|unirender_evaluation)/py\.typed",
        r"unirender-.*\.dist-info/licenses/LICENSE",
        r"unirender_reference/data/lights/LICENSES\.txt",
        r"unirender_evaluation/data/LICENSES\.txt",
    ):
        assert any(re.fullmatch(pattern, name) for name in sizes), f"no {pattern} in the wheel"
    checkpoint_mb = sum(size for name, size in sizes.items() if name.startswith("unirender/checkpoints/")) / 1e6
    assert 0.1 < checkpoint_mb <= MAX_CHECKPOINT_MB
    assert not [name for name in sizes if name.endswith((".pyc", ".DS_Store")) or "__pycache__" in name]
    assert not [name for name in sizes if name.startswith("unirender_evaluation/pages/")]


def test_the_source_distribution_stays_small() -> None:
    files = {
        file.distribution_path: os.path.getsize(file.path) for file in SdistBuilder(str(ROOT)).recurse_included_files()
    }
    size_mb = sum(files.values()) / 1e6
    assert size_mb <= MAX_SDIST_MB, f"{size_mb:.1f} MB, expected at most {MAX_SDIST_MB}"
    assert {"Makefile", "constraints.txt", "evaluation/results/tiny/results.json.gz"} <= set(files)
    assert "evaluation/unirender_evaluation/data/suites/tiny.tar" in files


def test_decompose_runs_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    y, x = np.mgrid[-1:1:40j, -1:1:48j]
    inside = x**2 + y**2 < 0.8
    rgba = np.zeros((40, 48, 4), np.uint8)
    rgba[inside] = (200, 120, 60, 255)
    Image.fromarray(rgba).save(tmp_path / "ball.png")

    run([str(installed / "unirender"), "decompose", "ball.png", "--output", "out", "--seed", "0"], tmp_path)

    channels, _ = read_exr(tmp_path / "out" / "intrinsics.exr")
    assert {"albedo.R", "normal.X", "roughness.Y", "metallic.Y"} <= set(channels)
    for name, values in channels.items():
        assert values.shape == (40, 48), name
        assert np.isfinite(values).all(), name
    assert (tmp_path / "out" / "environment.exr").is_file()
    assert (tmp_path / "out" / "meta.json").is_file()


def test_help_answers_at_once(installed: Path, tmp_path: Path) -> None:
    """CPU time, not wall clock: a busy machine must not decide. The least of several, the first fills caches."""
    seconds = []
    for _ in range(4):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        text = run([str(installed / "unirender"), "--help"], tmp_path).stdout
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
        assert "decompose" in text
    assert min(seconds) < MAX_HELP_SECONDS, f"{min(seconds):.2f} s of CPU time"
