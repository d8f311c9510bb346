"""Layers: what may import what (the oracle is independent of what it judges); each contract with its failing twin."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"src": "unirender", "reference": "unirender_reference", "evaluation": "unirender_evaluation"}
VOCABULARY = {
    f"unirender.{name}"
    for name in (
        "arguments",
        "blocks",
        "camera",
        "cicp",
        "color",
        "composite",
        "display_files",
        "errors",
        "exposure",
        "exr",
        "files",
        "ggx",
        "icc",
        "intrinsics",
        "lighting",
        "machine",
        "paths",
        "pictures",
        "primaries",
        "score",
        "sixteen_bits",
        "surface_light",
        "symmetries",
        "vectors",
        "visualization",
        "whole_files",
        "worker_pool",
        "writing",
    )
}
HEAVY = ("torch", "diffusers", "mitsuba", "drjit", "matplotlib", "skimage", "gradio")


def run_python(code: str, cwd: Path) -> str:
    result = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_reference_imports_the_shared_vocabulary_and_nothing_else_of_unirender() -> None:
    graph = grimp.build_graph("unirender", "unirender_reference", cache_dir=None)
    imported = {
        target
        for module in graph.modules
        if module.split(".")[0] == "unirender_reference"
        for target in graph.find_modules_directly_imported_by(module)
        if target.split(".")[0] == "unirender"
    }
    assert imported
    assert imported <= VOCABULARY, f"not shared vocabulary: {sorted(imported - VOCABULARY)}"


@pytest.mark.parametrize("modules", ["unirender", "unirender, unirender.cli", ", ".join(sorted(VOCABULARY))])
def test_nothing_heavy_is_imported_by(modules: str, tmp_path: Path) -> None:
    loaded = run_python(f"import sys, {modules}; print(*sorted({{m.split('.')[0] for m in sys.modules}}))", tmp_path)
    assert not set(HEAVY) & set(loaded.split())


def test_of_two_modules_that_need_each_other_either_can_come_first(tmp_path: Path) -> None:
    run_python("import unirender_reference.textures", tmp_path)  # the shapes are coloured by it, and share its noise


def lint_imports(folder: Path) -> str:
    """Returns what import-linter says of a copy of the three packages; empty where every contract is kept."""
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    paths = ":".join(str(folder / root) for root in PACKAGES)
    result = subprocess.run(
        command, cwd=folder, env={"PYTHONPATH": paths, "PATH": ""}, capture_output=True, text=True, check=False
    )
    return "" if result.returncode == 0 else result.stdout + result.stderr


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources that a test may break."""
    folder = tmp_path_factory.mktemp("layering")
    for root, package in PACKAGES.items():
        ignore = shutil.ignore_patterns("__pycache__", "data", "*.safetensors")
        shutil.copytree(ROOT / root / package, folder / root / package, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@pytest.mark.slow
def test_the_contracts_are_kept(checkout: Path) -> None:
    assert lint_imports(checkout) == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("src/unirender/camera.py", "import torch", "shared vocabulary"),
        ("src/unirender/ggx.py", "import torch", "shared vocabulary"),
        ("src/unirender/scene_export/card.py", "import mitsuba", "knows nothing of the ground truth"),
        ("src/unirender/pipelines/__init__.py", "import mitsuba", "knows nothing of the ground truth"),
        ("src/unirender/training/__init__.py", "import unirender_evaluation", "knows nothing of the ground truth"),
        (
            "src/unirender/models/build.py",
            "import unirender.training.presets",
            "training > pipelines > diffusion > models",
        ),
        ("reference/unirender_reference/__init__.py", "import unirender.models", "independent of the model"),
        ("reference/unirender_reference/shade.py", "import unirender.scene_export", "independent of the model"),
        ("evaluation/unirender_evaluation/__init__.py", "import unirender.cli", "composition root"),
        ("src/unirender/exr.py", "import unirender_reference", "unirender_evaluation > unirender_reference"),
    ],
)
def test_a_forbidden_import_breaks_its_contract(checkout: Path, module: str, line: str, contract: str) -> None:
    path = checkout / module
    before = path.read_text() if path.exists() else None
    try:
        # Inside a function: the linter counts those imports too.
        path.write_text(f"{before or ''}\n\ndef _forbidden():\n    {line}\n")
        said = lint_imports(checkout)
    finally:
        if before is None:
            path.unlink()
        else:
            path.write_text(before)
    assert re.search(rf"{re.escape(contract)}.* BROKEN", said), said
