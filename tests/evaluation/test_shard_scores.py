"""Scores on pictures of data sets: what is drawn, what is compared with what, what is printed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from synthetic_shards import group_members, write_dataset, write_shard

from unirender.cli import main
from unirender.composite import composite_image
from unirender.errors import UsageError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.shard_scores import COLUMNS, RENDERS, minus, scored, shard_tables
from unirender_evaluation.shard_scores_command import BenchShards
from unirender_evaluation.statistics import UNPRINTED, mean_estimate

SIZE = 16


@dataclass
class Found:
    intrinsics: Intrinsics


class Halves:
    """Answers 0.5 for metallic and roughness, black for albedo, whatever it sees; remembers what it saw."""

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray) -> Found:
        self.seen.append(image_srgb)
        half = np.full_like(mask, 0.5)
        return Found(Intrinsics(albedo=np.zeros_like(image_srgb), metallic=half, roughness=half, mask=mask))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data"), shards=2, groups=3, size=SIZE)


def test_every_picture_is_held_against_its_own_truth(folder: Path) -> None:
    method = Halves()
    found = list(scored(method, folder, objects=100, pairs=100, seed=0))
    assert len({one.group for one in found}) == 6
    assert {one.metallic for one in found} == {0.0, 0.5, 1.0}
    for one in found:
        assert one.metallic is not None
        assert one.scores[metric_key("metallic", "mse_object")] == pytest.approx((one.metallic - 0.5) ** 2, abs=1e-6)
        assert metric_key("normal", "cosine") not in one.scores
    for image in method.seen:
        np.testing.assert_allclose(image * 255, np.round(image * 255), atol=1e-3)  # 8 bits, as methods see pictures


def test_a_draw_is_of_its_seed_and_no_larger_than_asked(folder: Path) -> None:
    def drawn(seed: int) -> list[tuple[str, float | None]]:
        return [(one.group, one.metallic) for one in scored(Halves(), folder, objects=2, pairs=2, seed=seed)]

    assert drawn(1) == drawn(1)
    assert len({tuple(drawn(seed)) for seed in range(5)}) > 1
    assert len(drawn(0)) == 4
    assert len({group for group, _ in drawn(0)}) == 2


def test_the_table_has_a_row_for_each_folder_and_metallic(folder: Path) -> None:
    found = list(scored(Halves(), folder, objects=6, pairs=100, seed=0))
    (table,) = shard_tables(found, "Halves.")
    (rows,) = table.sections
    assert [row[0] for row in rows] == [f"{folder}: all", "metallic 0", "metallic 0.5", "metallic 1"]
    metallic = 3 + list(COLUMNS).index("metallic MSE ↓")
    assert [row[metallic].split(" ")[0] for row in rows[1:]] == ["0.2500", "0.0000", "0.2500"]
    assert {row[3 + list(COLUMNS).index("normal cos ↑")] for row in rows} == {"-"}
    assert int(rows[0][2]) == sum(int(row[2]) for row in rows[1:])


def test_the_groups_of_one_object_count_as_one(tmp_path: Path) -> None:
    """As of `unirender dataset --vary one-at-a-time`: three objects of two groups each."""
    made = {
        f"train-{i:06d}_g{k}": group_members("one-at-a-time", SIZE, 1, (40,), (0, 100), 3 * i + k)
        for i in range(3)
        for k in range(2)
    }
    write_shard(tmp_path / "shard-000000.tar", made)
    found = list(scored(Halves(), tmp_path, objects=60, pairs=100, seed=0))
    assert len({one.group for one in found}) == 6
    assert {one.object for one in found} == {"train-000000", "train-000001", "train-000002"}
    key, decimals = COLUMNS["albedo (dB) ↑"]
    clustered, wrong = (
        mean_estimate([one.scores[key] for one in found], [getattr(one, of) for one in found])
        for of in ("object", "group")
    )
    cells = shard_tables(found, "Halves.")[0].sections[0][0]
    assert cells[1:3] == ("3", "12")
    assert cells[3].endswith(f"± {clustered.half_width:.{decimals}f}")
    assert not cells[3].endswith(f"± {wrong.half_width:.{decimals}f}")
    (table,) = shard_tables([one for one in found if one.object != "train-000002"], "Halves.")
    assert not any("±" in cell for cell in table.sections[0][0])
    assert table.notes[1:] == (UNPRINTED,)
    drawn = list(scored(Halves(), tmp_path, objects=1, pairs=4, seed=0))
    assert (len(drawn), len({one.object for one in drawn})) == (4, 1)


class Painter(Halves):
    """Renders the composite of what it is given, or black where s and d are left to it; remembers which, and its
    lights."""

    def __init__(self) -> None:
        super().__init__()
        self.given: list[bool] = []
        self.lights: list[np.ndarray] = []

    def render(self, intrinsics: Intrinsics) -> np.ndarray:
        self.given.append(intrinsics.specular is not None)
        assert (intrinsics.specular is None) == (intrinsics.diffuse is None)
        assert intrinsics.environment is not None
        self.lights.append(intrinsics.environment)
        return composite_image(intrinsics) if self.given[-1] else np.zeros_like(intrinsics.require("albedo")["albedo"])


def test_renders_are_scored_where_they_are_asked_for(folder: Path) -> None:
    method = Painter()
    found = list(scored(method, folder, objects=1, pairs=2, seed=0, renders=True))
    assert method.given == [True, False, True, False]
    for one in found:
        given, light, closed = (one.scores[key] for key, _ in RENDERS.values())
        assert np.isfinite(closed)
        assert given > light
    assert {light.shape for light in method.lights} == {(8, 16, 3)}  # as the shards have it, not as the model reads it
    maps, renders = shard_tables(found, "Painter.")
    assert maps.columns[3:] == tuple(COLUMNS)
    assert renders.columns[3:] == tuple(RENDERS)
    assert all("Painter." in table.notes[0] for table in (maps, renders))
    assert "number" in maps.notes[0]
    assert "closed form" in renders.notes[0]
    assert len(shard_tables(list(scored(method, folder, 1, 1, 0)), "Painter.")) == 1


class Thirds(Halves):
    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray) -> Found:
        third = np.full_like(mask, 1 / 3)
        return Found(Intrinsics(metallic=third, roughness=third, mask=mask))


def test_differences_are_of_the_same_pictures(folder: Path) -> None:
    halves, thirds = (list(scored(method, folder, objects=4, pairs=2, seed=3)) for method in (Halves(), Thirds()))
    with pytest.raises(ValueError, match="zip"):
        minus(thirds, halves[1:])
    for one in (found := minus(thirds, halves)):
        assert one.metallic is not None
        expected = (one.metallic - 1 / 3) ** 2 - (one.metallic - 0.5) ** 2
        assert one.scores[metric_key("metallic", "mse_object")] == pytest.approx(expected, abs=1e-6)
    assert [(one.group, one.metallic) for one in found] == [(one.group, one.metallic) for one in halves]


def test_the_command_sets_a_model_against_another(folder: Path, tmp_path: Path) -> None:
    BenchShards(data=(folder,), objects=2, pairs=1, renders=True, against=Path("tiny"), out=tmp_path / "t.md").run()
    text = (tmp_path / "t.md").read_text()
    assert text.count("###") == 4
    maps, renders = (line.split(" | ") for line in text.split(": differences", 1)[1].splitlines() if ": all |" in line)
    for cells in (maps, renders):
        assert float(cells[3].split(" ")[0]) == 0  # albedo, and given: tiny against itself
    assert " minus " in text


@pytest.mark.parametrize("columns", [80, 200])
def test_the_command_scores_the_shipped_model(
    columns: int,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    assert BenchShards(data=(folder,), objects=1, pairs=1, renders=True, out=tmp_path / "t.md").run() == 0
    text = (tmp_path / "t.md").read_text()
    assert set(RENDERS) <= set(map(str.strip, text.split("|")))
    printed = capsys.readouterr().out
    assert "albedo" in printed
    assert "…" not in printed  # nothing is cut off on a narrow terminal
    assert text.startswith("### Pictures of data sets")
    assert " nan" not in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": ()}, "at least one folder"),
        ({"data": (Path("a"), Path("a"))}, "none of them twice"),
        ({"data": (Path("a"),), "objects": 0}, "objects"),
    ],
)
def test_what_cannot_be_asked_is_refused(options: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        BenchShards(**options).check()


def test_a_folder_without_shards_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["bench", "shards", "--data", str(tmp_path / "absent")])
    assert "absent" in capsys.readouterr().err
