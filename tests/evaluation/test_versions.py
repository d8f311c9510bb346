"""Content keys: each part's version follows its files, its libraries and its data, and nothing else."""

import ast
from fnmatch import fnmatch
from pathlib import Path

import pytest

from unirender.errors import UnirenderError
from unirender_evaluation import lpips
from unirender_evaluation.runs.config import BenchConfig, build_rows
from unirender_evaluation.versions import (
    LPIPS,
    MODEL,
    MULTIVIEW,
    NOT_IN_OPTIMIZED,
    OPTIMIZER,
    PARTS,
    REFERENCE,
    Part,
    Versions,
    lpips_version,
    modules_version,
    package_folder,
    part_version,
    versions,
)

PART = Part({"package": ("*.py", "data/**/*.*")}, ("numpy",), ("package/report*.py",), ("UNIRENDER_TEST_VARIABLE",))


@pytest.fixture
def package(tmp_path: Path) -> Path:
    for name in ("score.py", "report_plots.py", "data/lights/sun.exr", "sub/unlisted.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


def test_a_part_follows_its_files_and_data(package: Path) -> None:
    before = part_version(PART, {"package": package})
    assert part_version(PART, {"package": package}) == before
    for name in ("report_plots.py", "sub/unlisted.py"):
        (package / name).write_text("changed")
    assert part_version(PART, {"package": package}) == before
    seen = {before}
    for name in ("score.py", "data/lights/sun.exr", "data/new.toml"):
        (package / name).write_text("changed")
        seen.add(part_version(PART, {"package": package}))
    (package / "score.py").rename(package / "scores.py")
    seen.add(part_version(PART, {"package": package}))
    assert len(seen) == 5


def test_a_part_follows_its_variables(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = part_version(PART, {"package": package})
    monkeypatch.setenv("UNIRENDER_TEST_VARIABLE", "cuda")
    assert part_version(PART, {"package": package}) != before


@pytest.mark.parametrize(
    ("part", "package", "files"),
    [
        ("core", "unirender", ("composite.py", "environment_brdf.npy", "light/environment.py", "picture_files/icc.py")),
        ("core", "unirender_evaluation", ("scoring.py", "metrics.py", "ssim.py", "tasks.py", "tables/specs.py")),
        (MODEL, "unirender", ("models/dual_stream.py", "pipelines/editing.py", "diffusion/inference.py")),
        (REFERENCE, "unirender_reference", ("shade.py", "shapes/parametric.py", "lights/bundled.py")),
        (REFERENCE, "unirender_reference", ("data/lights/lights.toml", "data/lights/pmndrs-city.exr")),
        (OPTIMIZER, "unirender_reference", ("optimize/refine/run.py", "optimize/reduction.py", "multiview.py")),
        (OPTIMIZER, "unirender_evaluation", ("methods/optimized.py",)),
        (MULTIVIEW, "unirender_reference", ("optimize/views.py", "optimize/solution.py", "multiview.py")),
        (MULTIVIEW, "unirender_evaluation", ("multiview/scoring.py", "multiview/settings.py")),
        ("core", "unirender_evaluation", ("physics/formulas.py", "physics/rows.py", "records.py")),
        (
            "core",
            "unirender_evaluation",
            ("light_balls.py", "light_metrics.py", "methods/light.py", "methods/trivial.py", "methods/composite.py"),
        ),
        ("core", "unirender_evaluation", ("methods/method.py", "predictions/folder.py", "suites/suite.py")),
        (
            "core",
            "unirender_reference",
            ("lights/files.py", "lights/light.py", "lights/photograph.py", "lights/radiance.py"),
        ),
    ],
)
def test_what_results_depend_on_is_covered(part: str, package: str, files: tuple[str, ...]) -> None:
    root = package_folder(package)
    covered = {path for pattern in PARTS[part].files[package] for path in root.glob(pattern)}
    assert {root / name for name in files} <= covered
    assert not [name for name in files for pattern in PARTS[part].without if fnmatch(f"{package}/{name}", pattern)]


@pytest.mark.parametrize(
    ("part", "package", "files"),
    [
        ("core", "unirender_evaluation", ("methods/optimized.py",)),
        (REFERENCE, "unirender_reference", ("optimize/refine/run.py", "optimize/shape/hull.py", "multiview.py")),
        (OPTIMIZER, "unirender_reference", ("optimize/commands.py", "optimize/files/folder.py")),
    ],
)
def test_a_change_of_the_optimiser_concerns_its_own_rows(part: str, package: str, files: tuple[str, ...]) -> None:
    for name in files:
        assert any(fnmatch(f"{package}/{name}", pattern) for pattern in PARTS[part].without), name


def test_what_the_optimiser_finds_needs_no_file_that_its_key_leaves_out() -> None:
    """Of those it takes what reads, refuses and writes; `reduced`, which the start solves with, was among them."""
    left_out = {f"unirender_reference.optimize.{name.replace('/', '.')}" for name in NOT_IN_OPTIMIZED}
    taken: set[str] = set()
    for path in (package_folder("unirender_reference") / "optimize").rglob("*.py"):
        own = path.relative_to(package_folder("unirender_reference").parent).with_suffix("")
        if ".".join(own.parts) in left_out:
            continue
        for line in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(line, ast.ImportFrom) and line.module in left_out:
                taken |= {alias.name for alias in line.names}
    assert taken == {
        *("check_in_picture", "shifted_principal", "short_list", "sphere_of_masks"),
        *("read_picture_file", "write_record", "write_solution", "SOLUTION_FILE"),
        *("turntable", "views_strip"),
    }


@pytest.mark.parametrize(
    "name",
    [
        *("__init__", "commands", "crosscheck", "methods/__init__", "runs/command", "score_api", "statistics"),
        *("report/page", "results/check", "results/commands", "results/merge", "results/schema", "runs/report"),
        *("suites/check", "suites/home", "suites/lights", "table_list", "tables/lights", "truth/commands"),
        "truth/make",
    ],
)
def test_what_no_value_depends_on_is_in_no_key(name: str) -> None:
    root = package_folder("unirender_evaluation")
    path = root / f"{name}.py"
    assert path.is_file()
    for part in PARTS.values():
        read = {found for pattern in part.files.get("unirender_evaluation", ()) for found in root.glob(pattern)}
        assert path not in read or any(fnmatch(f"unirender_evaluation/{name}.py", left) for left in part.without)


def test_packages_beside_the_benchmark_are_in_no_key() -> None:
    root = package_folder("unirender_evaluation")
    folders = {
        name: {path.relative_to(root).parent.as_posix() for p in patterns for path in root.glob(p)}
        for name, part in PARTS.items()
        if (patterns := part.files.get("unirender_evaluation"))
    }
    assert folders.pop(MULTIVIEW) == {"multiview"}
    assert folders.pop("core") == {".", "methods", "physics", "predictions", "runs", "suites", "tables", "truth"}
    assert set().union(*folders.values()) == {"adapters", "methods"}


def test_a_study_whose_modules_were_moved_does_not_go_on_without_them() -> None:
    assert modules_version("public/orb*") != modules_version("public/orb")
    with pytest.raises(ValueError, match="public/gone"):
        modules_version("public/orb", "public/gone")


@pytest.mark.parametrize("name", ["mix_command", "mix_folder", "meshes/mix", "meshes/write_obj"])
def test_what_makes_training_data_is_in_no_key(name: str) -> None:
    path = f"unirender_reference/{name}.py"
    assert (package_folder("unirender_reference") / f"{name}.py").is_file()
    assert any(fnmatch(path, pattern) for pattern in PARTS[REFERENCE].without)
    modules = [m for part in ("reference", "evaluation") for m in package_folder(f"unirender_{part}").rglob("*.py")]
    importing = f"unirender_reference.{name.replace('/', '.')} import"
    users = {module.stem for module in modules if importing in module.read_text()}
    assert users <= {"mix_command", "mix_folder"}, "what renders depends on it"


def test_a_record_follows_the_weights_and_not_where_they_lie() -> None:
    assert any(fnmatch("unirender/shipped.py", pattern) for pattern in PARTS["core"].without)
    rows = [build_rows(BenchConfig(methods=("ours",), checkpoint=Path(name))) for name in ("tiny", "small")]
    for one, other in zip(*rows, strict=True):
        assert one.info.key == other.info.key
        assert one.config != other.config


@pytest.mark.parametrize(("name", "part"), [("adapters/marigold", MODEL), ("methods/mitsuba", REFERENCE)])
def test_a_row_of_other_code_follows_the_part_of_that_code_alone(name: str, part: str) -> None:
    root = package_folder("unirender_evaluation")
    path = root / f"{name}.py"
    owners = [
        key
        for key, p in PARTS.items()
        if any(path in root.glob(pattern) for pattern in p.files.get("unirender_evaluation", ()))
        and not any(fnmatch(f"unirender_evaluation/{name}.py", pattern) for pattern in p.without)
    ]
    assert owners == [part]


def test_a_record_follows_the_parts_that_its_row_uses() -> None:
    """Another network leaves the composite's records valid; another Mitsuba leaves the network's."""
    before = Versions("core", {MODEL: "a", REFERENCE: "b", LPIPS: "c"})
    network = Versions("core", {MODEL: "changed", REFERENCE: "b", LPIPS: "c"})
    assert network.of({LPIPS}) == before.of({LPIPS})
    assert network.of({REFERENCE, LPIPS}) == before.of({REFERENCE, LPIPS})
    assert network.of({MODEL, LPIPS}) != before.of({MODEL, LPIPS})
    assert Versions("changed", before.parts).of() != before.of()
    assert len({network.code, before.code, Versions("changed", before.parts).code}) == 3


def test_lpips_values_follow_the_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path))
    alex = lpips_version(("alex",))
    path = lpips.weights_path("vgg")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"some weights")
    both = lpips_version(("alex", "vgg"))
    path.write_bytes(b"other weights")
    assert len({alex, both, lpips_version(("alex", "vgg"))}) == 3
    path.unlink()
    with pytest.raises(UnirenderError, match="LPIPS-vgg"):
        lpips_version(("vgg",))


def test_versions_of_this_installation() -> None:
    found = versions(("alex",))
    assert set(found.parts) == {MODEL, REFERENCE, LPIPS, OPTIMIZER, MULTIVIEW}
    assert {len(value) for value in (found.core, found.code, *found.parts.values())} == {64}
    assert found == versions(("alex",))
    assert found.of({LPIPS}) != versions(()).of({LPIPS})
    assert found.of() == versions(()).of()
