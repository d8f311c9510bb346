"""What results depend on besides the suite and the method: the code, libraries and data of each part, as hashes.

Every content key holds the version of the *core* (shared vocabulary and scorer) and of those other parts that its row
uses, so that a change of the network's code leaves the composite's records valid, and one of a report nobody's.

    core        shared vocabulary, tasks, methods, metrics, what reads predictions
    lpips       the backbones' weights, by content: every row whose pictures are scored
    model       the network, its diffusion and pipeline, and the adapters of others' pipelines: our rows, and plug-ins,
                which may call them
    reference   Mitsuba, its row, the generators of shapes and the lights with their data: every row that renders
    optimizer   inverse rendering by optimisation: its rows
    multiview   scenes and scores of the multi-view table: its rows
"""

import hashlib
import importlib.metadata
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from importlib.util import find_spec
from pathlib import Path

from unirender.errors import UnirenderError

MODEL, REFERENCE, LPIPS = "model", "reference", "lpips"
OPTIMIZER, MULTIVIEW = "optimizer", "multiview"
SEPARATOR = "/"  # between the core's version and those of the other parts


@dataclass(frozen=True)
class Part:
    """What makes up a part."""

    files: Mapping[str, tuple[str, ...]]  # package -> patterns below its folder
    libraries: tuple[str, ...]  # distributions
    without: tuple[str, ...] = ()  # `package/path` (patterns) of files that results do not depend on
    variables: tuple[str, ...] = ()  # of the environment


LIGHT_READER = tuple(f"lights/{name}.py" for name in ("files", "light", "photograph", "radiance"))  # of predictions

# Not in any record: commands and what makes the suites (which have hashes of their own), and all that is made from
# the records anew at the end of every run.
COMMANDS = (
    "*/__init__",
    "*_command",
    "*/command",
    "*/commands",
    "__init__",
    "commands",
    "crosscheck",
    "export",
    "lpips_convert",
    "physics/ambiguity",
    "physics/region",
    "physics/run",
    "physics/tracer",
    "physics/twins",
    "predictions/check",
    "runs/benchmark",
    "runs/cluster",
    "runs/config",
    "runs/dry_run",
    "runs/folder",
    "runs/report",
    "runs/workers",
    "score_api",
    "shard_scores",
    "subsets",
    "suites/check",
    "suites/definition",
    "suites/home",
    "suites/lights",
    "truth/make",
    "truth/sources",
    "validation",
)
FROM_RECORDS = ("ceiling", "claims", "comparisons", "statistics", "table_list", "verdict")
# Of the shared vocabulary's folder: the docstrings of its packages, the command line, names of checkpoints, processes,
# and what is said of errors and shown of objects.
OUTSIDE = (
    "*/__init__",
    "__main__",
    "cli",
    "shipped",
    "shown",
    "system/ends",
    "system/notices",
    "system/run_progress",
    "system/system_errors",
    "system/wording",
    "system/worker_pool",
    "system/writing",
)
# The rooms that records are made in, and of the tables what is asked. Results and the report are made from records.
ROOMS = ("*.py", "methods/*.py", "physics/*.py", "predictions/*.py", "runs/*.py", "suites/*.py", "truth/*.py")
QUESTIONS = "tables/specs.py"
# Parts of their own: a change there concerns no other row.
OPTIMIZED = ("methods/optimized*",)
VIEWS = ("multiview/*",)
ADAPTERS = ("adapters/*",)  # of other people's pipelines, which enter as plug-ins do
MITSUBA_ROW = ("methods/mitsuba",)
# What makes data sets, checks the ground truth, measures it or reads files: no record is made with it.
NOT_IN_RECORDS = (
    "checks/*",
    "cluster",
    "cluster_machine",
    "commands",
    "dataset*",
    "denoise",
    "effects",
    "faults",
    "folder_lock",
    "group",
    "journal",
    "lights/summary",
    "lights/twins",
    "lobes",
    "measure/*",
    "members",
    "meshes/mix",
    "meshes/write_obj",
    "mix_command",
    "mix_folder",
    "multiview",
    "option_checks",
    "optimize/*",
    "output_files",
    "plan",
    "principled",
    "processes",
    "recipe",
    "resume",
    "shards",
    "sheets",
    "sweep*",
    "versions",
    "visibility",
    "workers",
)
# Commands and files of the optimiser: what it finds does not depend on them.
NOT_IN_OPTIMIZED = (
    "*/__init__",
    "commands",
    "files/export",
    "files/folder",
    "files/glb",
    "files/transforms",
    "shape/misplaced",
    "shape/placement",
    "shape/principal",
    "show/strips",
)
PARTS: Mapping[str, Part] = {
    "core": Part(
        {
            "unirender": ("*.py", "*.npy", "light/*.py", "picture_files/*.py", "system/*.py"),
            "unirender_evaluation": (*ROOMS, QUESTIONS),
            "unirender_reference": LIGHT_READER,
        },
        ("numpy", "scipy", "scikit-image", "colour-science", "OpenEXR", "pillow"),
        (
            *(f"unirender/{name}.py" for name in OUTSIDE),
            *(
                f"unirender_evaluation/{name}.py"
                for name in (*COMMANDS, *FROM_RECORDS, "versions", *OPTIMIZED, *MITSUBA_ROW)
            ),
        ),
    ),
    MODEL: Part(
        {
            "unirender": ("models/**/*.py", "diffusion/**/*.py", "pipelines/**/*.py", "checkpoints/*.safetensors"),
            "unirender_evaluation": tuple(f"{name}.py" for name in ADAPTERS),
        },
        ("torch", "diffusers"),
        ("unirender_evaluation/adapters/__init__.py",),
    ),
    REFERENCE: Part(
        {
            "unirender_reference": ("**/*.py", "data/**/*.*"),
            "unirender_evaluation": tuple(f"{name}.py" for name in MITSUBA_ROW),
        },
        ("mitsuba", "drjit", "karellen-llvm-core"),
        (
            "*/LICENSES.txt",
            "unirender_reference/data/recipes/*",
            *(f"unirender_reference/{name}.py" for name in NOT_IN_RECORDS),
        ),
        ("UNIRENDER_MITSUBA_VARIANT",),
    ),
    OPTIMIZER: Part(
        {
            "unirender_reference": ("optimize/**/*.py", "multiview.py"),
            "unirender_evaluation": tuple(f"{name}.py" for name in OPTIMIZED),
        },
        ("cholespy", "xatlas"),
        tuple(f"unirender_reference/optimize/{name}.py" for name in NOT_IN_OPTIMIZED),
    ),
    MULTIVIEW: Part(
        {
            "unirender_reference": ("multiview.py", "optimize/solution.py", "optimize/views.py"),
            "unirender_evaluation": tuple(f"{name}.py" for name in VIEWS),
        },
        (),
        ("unirender_evaluation/multiview/__init__.py",),
    ),
}


@dataclass(frozen=True)
class Versions:
    """The version of every part: `parts` by the names above."""

    core: str
    parts: Mapping[str, str] = field(default_factory=dict)

    def of(self, uses: Collection[str] = ()) -> str:
        """The version of the core and of the parts that a record uses: what stands in its content key."""
        return SEPARATOR.join([self.core, *(f"{name} {self.parts[name]}" for name in sorted(uses))])

    @property
    def code(self) -> str:
        """One hash over all parts: what the protocol line prints."""
        return hashlib.sha256(self.of(self.parts).encode()).hexdigest()


def versions(backbones: Sequence[str] = ()) -> Versions:
    """The versions of what is installed here.

    Args:
        backbones: LPIPS backbones whose values are computed.

    Raises:
        UnirenderError: a package or the weights of a backbone are not there.
    """
    hashes = {name: part_version(part, {p: package_folder(p) for p in part.files}) for name, part in PARTS.items()}
    return Versions(hashes.pop("core"), {**hashes, LPIPS: lpips_version(backbones)})


def part_version(part: Part, folders: Mapping[str, Path]) -> str:
    """sha256 over a part's files, by name and content, its libraries' versions and its variables.

    Args:
        part: the part.
        folders: of its packages.
    """
    digest = hashlib.sha256()
    for package, patterns in part.files.items():
        root = folders[package]
        for path in sorted({p for pattern in patterns for p in root.glob(pattern) if p.is_file()}):
            name = f"{package}/{path.relative_to(root).as_posix()}"
            if "__pycache__" not in path.parts and not any(fnmatch(name, pattern) for pattern in part.without):
                digest.update(name.encode() + hashlib.sha256(path.read_bytes()).digest())
    for library in part.libraries:
        digest.update(f"{library} {installed_version(library)}".encode())
    for variable in part.variables:
        digest.update(f"{variable} {os.environ.get(variable, '')}".encode())
    return digest.hexdigest()


def modules_version(*names: str) -> str:
    """sha256 over modules of this package: what a study's figures depend on besides parts.

    Args:
        names: patterns of their paths below the package, without `.py`.

    Raises:
        ValueError: a pattern names no module.
    """
    package = "unirender_evaluation"
    root = package_folder(package)
    if unknown := [name for name in names if not any(root.glob(f"{name}.py"))]:
        raise ValueError(f"modules of {package}: {', '.join(unknown)}: there is none of that name")
    return part_version(Part({package: tuple(f"{name}.py" for name in names)}, ()), {package: root})


def lpips_version(backbones: Sequence[str]) -> str:
    """sha256 over the weights of the backbones and what computes with them.

    Raises:
        UnirenderError: weights are not here.
    """
    from unirender_evaluation.lpips import weights_path

    digest = hashlib.sha256(f"torch {installed_version('torch')}".encode())
    for name in sorted(backbones):
        path = weights_path(name)  # pyright: ignore[reportArgumentType] - the name of a backbone
        try:
            weights = path.read_bytes()
        except OSError as error:
            raise UnirenderError(f"LPIPS-{name}: {path} cannot be read ({error.strerror}), expected weights") from error
        digest.update(name.encode() + hashlib.sha256(weights).digest())
    return digest.hexdigest()


def package_folder(package: str) -> Path:
    """Where an installed package is.

    Raises:
        UnirenderError: it is not installed.
    """
    found = find_spec(package)
    if found is None or not found.submodule_search_locations:
        raise UnirenderError(f"package {package!r} is not installed: `pip install -e .`")
    return Path(found.submodule_search_locations[0])


def installed_version(distribution: str) -> str:
    """The version of an installed distribution, or "not installed"."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
