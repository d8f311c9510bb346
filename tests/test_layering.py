"""Layers: what may import what (the oracle is independent of what it judges); each contract with its failing twin."""

import importlib
import pkgutil
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
        "color",
        "composite",
        "environment_brdf",
        "errors",
        "exr",
        "files",
        "intrinsics",
        "new_folders",
        "light.environment",
        "light.exposure",
        "light.for_mitsuba",
        "light.ggx",
        "light.resampling",
        "light.surface_light",
        "light.symmetries",
        "map_edits",
        "picture_files.cicp",
        "picture_files.display_files",
        "picture_files.icc",
        "picture_files.primaries",
        "picture_files.sixteen_bits",
        "pictures",
        "score",
        "shown",
        "system.machine",
        "system.run_progress",
        "system.whole_files",
        "system.wording",
        "system.worker_pool",
        "system.writing",
        "vectors",
        "visualization",
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


def test_the_shared_vocabulary_imports_nothing_heavy(tmp_path: Path) -> None:
    modules = ", ".join(sorted(VOCABULARY))
    loaded = run_python(f"import sys, {modules}; print(*sorted({{m.split('.')[0] for m in sys.modules}}))", tmp_path)
    assert not set(HEAVY) & set(loaded.split())


@pytest.mark.parametrize("name", PACKAGES.values())
def test_what_a_package_exports_is_there_and_loads_nothing_before(name: str, tmp_path: Path) -> None:
    """Nor is it named as one of the package's modules, which would take its place when it is imported."""
    loaded = run_python(f"import sys, {name}; print(*sorted({{m.split('.')[0] for m in sys.modules}}))", tmp_path)
    assert not {*HEAVY, "numpy"} & set(loaded.split())
    package = importlib.import_module(name)
    assert not {module.name for module in pkgutil.iter_modules(package.__path__)} & set(package.__all__)
    assert all(hasattr(package, exported) for exported in package.__all__)


def test_of_two_modules_that_need_each_other_either_can_come_first(tmp_path: Path) -> None:
    run_python("import unirender_reference.textures", tmp_path)  # the shapes are coloured by it, and share its noise


def lint_imports(folder: Path) -> str:
    """What import-linter says of a copy of the three packages."""
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    paths = ":".join(str(folder / root) for root in PACKAGES)
    environment = {"PYTHONPATH": paths, "PATH": "", "COLUMNS": "200"}  # no import broken over two lines
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return result.stdout + result.stderr


FORBIDDEN = [
    ("src/unirender/camera.py", "torch", "shared vocabulary"),
    ("src/unirender/light/ggx.py", "torch", "shared vocabulary"),
    ("src/unirender/scene_export/card.py", "mitsuba", "knows nothing of the ground truth"),
    ("src/unirender/pipelines/__init__.py", "mitsuba", "knows nothing of the ground truth"),
    ("src/unirender/training/__init__.py", "unirender_evaluation", "knows nothing of the ground truth"),
    ("src/unirender/models/build.py", "unirender.training.presets", "training > pipelines > diffusion > models"),
    ("src/unirender/training/data/groups.py", "unirender.training.loop.state", "start > loop > data"),
    ("src/unirender/pipelines/loading.py", "unirender.command_line.options", "nothing of the command line"),
    ("src/unirender/training/loop/state.py", "unirender.command_line.parse", "nothing of the command line"),
    ("reference/unirender_reference/__init__.py", "unirender.models", "independent of the model"),
    ("reference/unirender_reference/shade.py", "unirender.scene_export", "independent of the model"),
    ("evaluation/unirender_evaluation/__init__.py", "unirender.cli", "composition root"),
    ("evaluation/unirender_evaluation/tables/build.py", "unirender_evaluation.report.page", "results > tables"),
    (
        "reference/unirender_reference/optimize/transport/solve.py",
        "unirender_reference.optimize.refine.run",
        "show > refine > transport",
    ),
    ("src/unirender/exr.py", "unirender_reference", "unirender_evaluation > unirender_reference"),
]


@pytest.mark.slow
def test_forbidden_imports_break_the_contracts(tmp_path: Path) -> None:
    """Each inside a function, whose imports the linter counts, too. `make lint` shows that the contracts are kept."""
    for root, package in PACKAGES.items():
        for file in (ROOT / root / package).rglob("*.py"):
            copy = tmp_path / file.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, copy)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for path, target, _ in FORBIDDEN:
        with (tmp_path / path).open("a") as file:
            file.write(f"\n\ndef _forbidden():\n    import {target}\n")
    said = lint_imports(tmp_path)
    for path, target, contract in FORBIDDEN:
        module = path.partition("/")[2].removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        broken = re.search(
            rf"^.*{re.escape(contract)}.*\n-+\n(?:(?!\n\n\n).|\n)*?{module} -> {target} \(l\.", said, re.M
        )
        assert broken, f"{module} -> {target}: {said}"
