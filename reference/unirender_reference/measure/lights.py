"""`unirender lights`: the lights there are, what a seed gives, a user's own folder; as tables, JSON, EXR, pictures."""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unirender.errors import UnirenderError, UsageError
from unirender.system.wording import counted
from unirender.system.writing import writing
from unirender_reference.output_files import ELSEWHERE, check_file, png_bytes, write_file

if TYPE_CHECKING:
    from PIL import Image
    from rich.table import Table

    from unirender_reference.lights import Light, LightPool
    from unirender_reference.lights.pool import Split

HOLDOUT, SHARE = 8, 0.5
MOST_COMPARED = 1000  # lights that are compared across the splits
MOST_SHOWN = 120  # lights on a sheet
THUMBNAIL, COLUMNS = (80, 160), 6


@dataclass(frozen=True)
class Lights:
    """Show the lights that scenes are drawn from: bundled maps, procedural kinds, the light of a seed, your folder."""

    split: Literal["train", "test"] | None = None
    """One side only; None: both."""
    draw: tuple[int, ...] = ()
    """Show the lights of these seeds, as a data set draws them."""
    pool: Path | None = None
    """Your folder of HDR, EXR or PFM maps and photographs: every file is read, and listed or refused with its reason.
    With `--draw`: a pool that seeds draw from."""
    holdout: int = HOLDOUT
    """Every so many-th place of that folder is for test."""
    share: float = SHARE
    """Share of the seeds that draw from that folder, in (0, 1]; with `--pool` and `--draw`."""
    export: Path | None = None
    """New folder for the lights shown: an EXR (float32, on the contract's grid) and a PNG preview of each."""
    sheet: Path | None = None
    """PNG with thumbnails of the lights shown."""
    json: bool = False
    """Print JSON instead of tables."""

    def run(self) -> int:
        """Returns the exit status: 1 where a file of the folder is no light."""
        from unirender_reference.lights.summary import kind_rows, light_row

        self._check()
        shown = _Shown()
        with _new_folder(self.export) as folder:
            for split, light in self._selected(shown):
                shown.rows.append({"split": split, **light_row(light)})
                if len(shown.kept) < MOST_COMPARED:
                    shown.kept.append((split, light))
                if folder is not None:
                    _export(folder, light)
            if self.sheet is not None and not shown.kept:
                first = "".join(f"; {failure['reason']}" for failure in shown.failures[:1])
                raise UnirenderError(f"{self.sheet}: no lights to show, expected at least one{first}")
        found = {"kinds": kind_rows(), "lights": shown.rows, "failures": shown.failures, "notes": []}
        count = len(shown.rows)
        if not self.draw and self.split is None:
            if count <= MOST_COMPARED:
                found["alike"] = _alike(shown.kept)
            else:
                found["notes"].append(f"not compared across the splits: {count} lights, more than {MOST_COMPARED}")
        if self.sheet is not None and count > MOST_SHOWN:
            found["notes"].append(f"{self.sheet}: the first {MOST_SHOWN} of {count} lights")
        if self.json:
            print(json.dumps(found, indent=2))
        else:
            self._print(found)
        if self.sheet is not None:
            write_file("--sheet", self.sheet, png_bytes(_sheet(shown.kept[:MOST_SHOWN])))
        return 1 if shown.failures else 0

    def _check(self) -> None:
        if any(seed < 0 for seed in self.draw):
            raise UsageError(f"--draw {min(self.draw)}: expected seeds of 0 or more")
        if self.holdout < 2 or not 0 < self.share <= 1:
            raise UsageError(
                f"--holdout {self.holdout}, --share {self.share:g}: expected at least 2, and a share in (0, 1]"
            )
        given = {"--holdout": self.holdout != HOLDOUT, "--share": self.share != SHARE}
        useless = {"--holdout": self.pool is None, "--share": self.pool is None or not self.draw}
        if found := [option for option in given if given[option] and useless[option]]:
            raise UsageError(
                f"{' and '.join(found)}: of a folder of lights{' that seeds draw from' if '--share' in found else ''}, "
                f"expected {'--pool and --draw' if '--share' in found else '--pool'} beside it"
            )
        if self.export is not None and self.export.exists():
            raise UnirenderError(f"{self.export}: is there already, expected a new folder; give another name")
        check_file("--export", self.export)
        check_file("--sheet", self.sheet)

    def _sides(self) -> "dict[Split, LightPool | None]":
        """The sides that were asked for, each with its part of the user's folder if there is one.

        A folder is listed without the side that it has no files for, but nobody can draw from that side.
        """
        from unirender_reference.lights.pool import divide, light_pool

        sides: tuple[Split, ...] = ("train", "test") if self.split is None else (self.split,)
        if self.pool is None:
            return dict.fromkeys(sides)
        if self.split is None and not self.draw:
            divided = divide(self.pool, self.holdout)
            sides = tuple(side for side in sides if divided[side]) or sides
        return {side: light_pool(self.pool, side, self.holdout, self.share) for side in sides}

    def _selected(self, shown: "_Shown") -> "Iterator[tuple[Split, Light]]":
        """The lights that the options ask for, one after the other; files that are none go into `shown.failures`."""
        from unirender_reference.lights import Light, bundled_lights, make_light

        for side, pool in self._sides().items():
            if self.draw:
                for seed in self.draw:
                    light = make_light(seed, side, pool)
                    for reason in filter(None, light.provenance.get("skipped", "").split("\n")):
                        shown.failures.append({"split": side, "reason": reason})
                    yield side, light
            elif pool is None:
                for light in bundled_lights(side):
                    yield side, light
            else:
                for _, light in pool.check():
                    if isinstance(light, Light):
                        yield side, light
                    else:
                        shown.failures.append({"split": side, "reason": str(light)})

    def _print(self, found: dict[str, Any]) -> None:
        from rich.console import Console

        from unirender_reference.lights.twins import SAME_PLACE

        console = Console()
        if not self.draw and self.pool is None:
            console.print(_kinds_table(found["kinds"]))
        console.print(_lights_table(found["lights"]))
        for failure in found["failures"]:
            print(f"No light ({failure['split']}): {failure['reason'].removeprefix('light ')}")
        for rank, pair in enumerate(found.get("alike", [])):
            if rank == 0 or pair["likeness"] >= SAME_PLACE:
                console.print(
                    f"Alike across the splits: {pair['test']} (test) and {pair['train']} (train), likeness "
                    f"{pair['likeness']:.2f}; one place has {SAME_PLACE:g} or more."
                )
        for note in found["notes"]:
            print(note)
        if found["lights"] and not self.draw:
            first, folder = found["lights"][0], self.pool or self.export
            path = (folder or Path("FOLDER")) / (first["provenance"]["file"] if self.pool else f"{first['name']}.exr")
            written = "" if folder else ", once --export FOLDER has written it"
            print(f"A light is used by its file: --environment '{path}'{written}.")


@dataclass
class _Shown:
    """What was selected: rows of all lights, the first lights themselves, and the files that are none."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    kept: "list[tuple[Split, Light]]" = field(default_factory=list)
    failures: list[dict[str, str]] = field(default_factory=list)


def _alike(lights: "list[tuple[Split, Light]]") -> list[dict[str, Any]]:
    """Each test light with the train light most like it."""
    from unirender_reference.lights.twins import most_alike

    test, train = ([light for side, light in lights if side == split] for split in ("test", "train"))
    pairs = sorted(most_alike(test, train), key=lambda pair: -pair.value)
    return [{"test": pair.first, "train": pair.second, "likeness": pair.value} for pair in pairs]


@contextlib.contextmanager
def _new_folder(path: Path | None) -> Iterator[Path | None]:
    """A folder that appears under its name when everything is in it, or not at all."""
    from unirender.new_folders import new_folder

    if path is None:
        yield None
        return
    with writing(f"--export {path}", ELSEWHERE), new_folder(path) as folder:
        yield folder


def _export(folder: Path, light: "Light") -> None:
    """Writes a light as EXR, on the grid, and a preview as PNG."""
    from PIL import Image

    from unirender.color import eight_bits
    from unirender.exr import write_environment
    from unirender_reference.sheets import environment_preview

    path = folder / f"{light.name}.exr"
    if path.exists():
        raise UnirenderError(
            f"{path.name}: two lights have this name, expected different ones; rename one of the files"
        )
    write_environment(path, light.environment, light.provenance)
    Image.fromarray(eight_bits(environment_preview(light.environment))).save(path.with_suffix(".png"))


def _sheet(lights: "list[tuple[Split, Light]]") -> "Image.Image":
    """Thumbnails of the lights, each over its name, split and what it is."""
    from unirender.light.resampling import resample_environment
    from unirender_reference.lights.summary import about
    from unirender_reference.sheets import captioned_sheet, environment_preview

    tiles = [environment_preview(resample_environment(light.environment, THUMBNAIL)) for _, light in lights]
    return captioned_sheet(tiles, [f"{light.name}\n{side}, {about(light)}" for side, light in lights], COLUMNS)


def _kinds_table(rows: list[dict[str, Any]]) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table("kind", "seeds", "what one draws", title="make_light(seed, split)", box=box.SIMPLE)
    for row in rows:
        table.add_row(row["kind"], f"{row['share']:.0%}", row["what"])
    return table


def _lights_table(rows: list[dict[str, Any]]) -> "Table":
    """One line a light. All means are 1, so only the peak differs: the largest luminance, in units of the mean."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    sizes = " or ".join(sorted({"{} x {}".format(*row["size"]) for row in rows}))
    title = f"{counted(len(rows), 'light')} of {sizes} texels, mean luminance 1"
    table = Table(title=title, box=box.SIMPLE)
    for name in ("light", "split", "peak / mean", "sha256"):
        table.add_column(name, no_wrap=True, justify="right" if name == "peak / mean" else "left")
    table.add_column("about", overflow="fold")
    for row in rows:
        name = Text(row["provenance"].get("file", row["name"]))  # a file's name is no markup
        table.add_row(name, row["split"], f"{row['peak_ratio']:.0f}", row["sha256"][:8], row["about"])
    return table
