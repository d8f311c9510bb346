"""`unirender meshes`: reads every mesh of a folder as a data set would, and prints what came of it."""

import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from unirender_reference.shapes import MeshObject


@dataclass(frozen=True)
class Meshes:
    """Read every mesh of a folder: why some are refused, what is ignored in the others, what it costs."""

    pattern: Annotated[str, tyro.conf.Positional]
    """A folder (searched with its folders), a file, or a quoted glob such as 'models/**/*.glb'."""
    limit: int | None = None
    """Read the first so many only."""
    json: bool = False
    """Print a line of JSON for each mesh instead of the table."""

    def run(self) -> int:
        """Returns the exit status: 1 where a mesh is refused or a folder cannot be listed."""
        from rich.console import Console

        console = Console(soft_wrap=True, highlight=False)
        found = MeshSummary()
        for row in read_meshes(self.pattern, self.limit):
            found.add(row)
            if self.json:
                print(json.dumps(row), flush=True)
            elif "reason" in row:
                console.print(f"refused  {row['reason']}", markup=False)
        if not self.json:
            console.print(found.table())
        return 1 if found.refused or found.unreadable else 0


def read_meshes(pattern: str, limit: int | None = None) -> Iterator[dict]:
    """Reads mesh after mesh and keeps none.

    Textures may lie anywhere in the folder of the pattern, as in a data set.

    Yields:
        `path` and `seconds` (of CPU) of each, with `reason` where it is refused; else `faces`, `atlas` (texels), `maps`
        and `constants` (which channels beside albedo the object has: pictures, and one value everywhere) and the
        provenance. For a folder that cannot be listed `folder` and `reason`.
    """
    from unirender.errors import UnirenderError
    from unirender_reference.mesh_folder import pattern_base
    from unirender_reference.meshes import find_meshes, load_mesh

    root = pattern_base(pattern)
    unreadable: list[tuple[Path, str]] = []
    for index, path in enumerate(find_meshes(pattern, lambda *folder: unreadable.append(folder))):
        if index == limit:
            break
        start = time.process_time()
        row: dict = {"path": str(path)}
        try:
            row |= _described(load_mesh(path, root))
        except UnirenderError as error:
            row["reason"] = str(error)
        yield row | {"seconds": time.process_time() - start}
    for folder, reason in unreadable:
        yield {"folder": str(folder), "reason": f"folder {folder}: cannot be listed ({reason}); check its permissions"}


def _described(obj: "MeshObject") -> dict:
    channels = {name: getattr(obj, name) for name in ("roughness", "metallic", "normal_map")}
    constant = {name: bool((texels == texels[:1, :1]).all()) for name, texels in channels.items() if texels is not None}
    return {
        "faces": len(obj.faces),
        "atlas": obj.albedo.size // 3,
        "maps": [name for name, same in constant.items() if not same],
        "constants": [name for name, same in constant.items() if same],
        "provenance": dict(obj.provenance),
    }


@dataclass
class MeshSummary:
    """Counts over the meshes that were read."""

    refused: int = 0
    unreadable: int = 0
    seconds: list[float] = field(default_factory=list)
    faces: list[int] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    def add(self, row: dict) -> None:
        """Counts one row of `read_meshes`."""
        if "folder" in row:
            self.unreadable += 1
            return
        self.seconds.append(row["seconds"])
        if "reason" in row:
            self.refused += 1
            return
        self.faces.append(row["faces"])
        provenance = row["provenance"]
        self.counts.update(f"with {name.replace('_', ' ')} of its own: a map" for name in row["maps"])
        self.counts.update(f"with {name.replace('_', ' ')} of its own: constant" for name in row["constants"])
        self.counts.update(f"ignored: {what}" for what in provenance["ignored"].split(", ") if what)
        for key in ("double_faces", "textures_averaged", "textures_baked"):
            self.counts[f"with {key.replace('_', ' ')}"] += provenance[key] != "0"

    def table(self):
        """A table for the terminal; times are of this process's CPU, memory is its largest so far."""
        import numpy as np
        from rich.table import Table

        from unirender.system.machine import peak_bytes

        table = Table("", "", show_header=False)
        table.add_row("meshes", f"{len(self.seconds):,}")
        table.add_row("read", f"{len(self.faces):,}")
        table.add_row("refused", f"{self.refused:,}")
        if self.unreadable:
            table.add_row("folders that cannot be listed", f"{self.unreadable:,}")
        for name, count in sorted(self.counts.items()):
            table.add_row(name, f"{count:,}")
        if self.faces:
            table.add_row("faces: median, largest", f"{int(np.median(self.faces)):,}, {max(self.faces):,}")
        median, tail, largest = np.quantile(self.seconds or [0.0], [0.5, 0.9, 1.0])
        table.add_row("CPU seconds: median, 90 %, largest", f"{median:.2f}, {tail:.2f}, {largest:.2f}")
        table.add_row("CPU seconds: all", f"{sum(self.seconds):.0f}")
        table.add_row("largest memory", f"{peak_bytes() / 2**20:,.0f} MiB")
        return table
