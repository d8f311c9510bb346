"""The figures: what is drawn where, what is asked of whom, and what the command refuses."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from PIL import Image, ImageFont
from tiny_suites import SIZE

from unirender.camera import Camera
from unirender.command_line.options import ModelOptions
from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender.system.whole_files import replace_file
from unirender_evaluation.figures import grid as grid_module
from unirender_evaluation.figures import light as light_module
from unirender_evaluation.figures import overview as overview_module
from unirender_evaluation.figures import panels
from unirender_evaluation.figures.command import ASKED, Figures, default_scenes, labels
from unirender_evaluation.figures.grid import (
    FONT,
    GAP,
    HEADING_LINES,
    MARGIN,
    WIDEST,
    Grid,
    Line,
    Tile,
    _headings,
    cell_side,
    draw,
    folded,
    save,
)
from unirender_evaluation.figures.light import light_figure
from unirender_evaluation.figures.overview import MAPS, map_tiles, overview
from unirender_evaluation.figures.panels import (
    MitsubaTruth,
    Subject,
    comparison_sheet,
    material_strip,
    other_lights,
    relighting_grid,
)
from unirender_evaluation.light_balls import ball_values
from unirender_evaluation.methods.light import MeanLight
from unirender_evaluation.methods.trivial import InputAsAlbedo, SphereNormal, UneditedInput
from unirender_evaluation.rows import make_row
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite, load_suite

UNEDITED = Subject("unedited", make_row(UneditedInput(), "trivial"))
ALBEDO = Subject("as albedo", make_row(InputAsAlbedo(), "trivial"))


class StoredTruth:
    """The suite's base picture whatever is asked, and what was asked."""

    def __init__(self, suite: Suite) -> None:
        self.suite, self.asked = suite, []

    def __call__(self, scene: Scene, material: MetallicRoughness, environment: np.ndarray) -> np.ndarray:
        self.asked.append((scene.key, material, float(environment.mean())))
        return self.suite.image(scene, self.suite.spec.base)


class Told:
    """A method that writes down what it is handed and answers black."""

    name, config = "told", {"told": 1}

    def __init__(self) -> None:
        self.calls: list[dict] = []

    def edit(self, image_srgb: np.ndarray, **given: Any) -> np.ndarray:
        self.calls.append(given)
        return np.zeros_like(image_srgb)

    relight = edit


def colour(level: float, height: int = 8, width: int = 8) -> np.ndarray:
    return np.full((height, width, 3), level, np.float32)


def test_every_tile_is_where_its_row_and_column_say_pixel_by_pixel(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).random((8, 8, 3), dtype=np.float32)
    green = np.broadcast_to(np.array([0.2, 0.8, 0.4], np.float32), (8, 8, 3))  # no text is green
    grid = Grid(("one", "two"), (Line("a", (Tile(green), None)), Line("b", (None, Tile(picture)))), "caption")
    side = cell_side(grid)
    assert side == 128
    sheet = np.asarray(Image.open(save(grid, tmp_path / "new" / "f.png")).convert("RGB"))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["f.png"], "no temporary file is left"
    place = np.argwhere((sheet == [51, 204, 102]).all(axis=-1))
    top, left = place.min(axis=0)
    assert (place.max(axis=0) - place.min(axis=0) + 1).tolist() == [side, side]
    there = sheet[top + side + GAP : top + 2 * side + GAP, left + side + GAP : left + 2 * side + GAP]
    np.testing.assert_array_equal(there[8::16, 8::16], np.round(picture * 255).astype(np.uint8))
    assert (sheet[top : top + side, left + side + GAP : left + 2 * side + GAP] == 255).all(), "a hole stays white"


def test_a_row_is_as_high_as_its_pictures_and_a_corner_has_its_text() -> None:
    flat = Grid(("light",), (Line("a", (Tile(colour(0.5, 4, 8)),)),))
    square = Grid(("light",), (Line("a", (Tile(colour(0.5)),)),))
    assert draw(square).height - draw(flat).height == 64
    said = replace(square, lines=(Line("a", (Tile(colour(0.5), "12.3 dB"),)),))
    assert np.asarray(draw(said)).tolist() != np.asarray(draw(square)).tolist()


@pytest.mark.parametrize(("columns", "parts"), [(1, [1]), (6, [6]), (7, [4, 3]), (12, [6, 6]), (15, [5, 5, 5])])
def test_many_columns_are_folded_into_even_parts(columns: int, parts: list[int]) -> None:
    assert [len(part) for part in folded(columns)] == parts
    assert [column for part in folded(columns) for column in part] == list(range(columns))


def test_a_folded_grid_shows_every_tile_below_the_first_ones_in_the_same_columns() -> None:
    count = 2 * WIDEST
    levels = [(10 * number, 255 - 10 * number, 7) for number in range(count)]  # no text has one of these colours
    tiles = tuple(Tile(np.broadcast_to(np.array(level, np.float32) / 255, (8, 8, 3))) for level in levels)
    sheet = np.asarray(draw(Grid(tuple("abcdefghijkl"), (Line("row", tiles),))))
    corners = [np.argwhere((sheet == level).all(axis=-1)).min(axis=0) for level in levels]
    tops, lefts = np.array(corners).reshape(2, WIDEST, 2).transpose(2, 0, 1)
    assert (np.diff(tops[0]) == 0).all()
    assert (np.diff(tops[1]) == 0).all()
    assert tops[1, 0] >= tops[0, 0] + 128
    assert lefts[0].tolist() == lefts[1].tolist()
    assert (np.diff(lefts[0]) == 128 + GAP).all()


LONG = ("my_inverse_renderer_without_light", "my_inverse_renderer_with_light")


def headings(*columns: str) -> np.ndarray:
    """What is drawn above the pictures of these columns, in darkness; 0 is white."""
    black = tuple(Tile(colour(0)) for _ in columns)
    sheet = np.asarray(draw(Grid(columns, (Line("", black),))).convert("L"))
    top = int(np.argmax((sheet == 0).sum(axis=1) >= 128 * len(columns)))
    return 255 - sheet[:top].astype(int)


def test_long_names_of_columns_are_whole_differ_and_keep_apart() -> None:
    font = ImageFont.load_default(FONT)
    found = _headings(("input", *LONG), font, 128)
    assert [" ".join(lines).replace("_ ", "_") for lines in found] == ["input", *LONG]
    assert all(font.getlength(line) <= 128 for lines in found for line in lines)
    assert max(map(len, found)) <= HEADING_LINES
    drawn, short = headings(*LONG), headings("one", "two")
    assert drawn.shape[0] > short.shape[0], "the pictures stand below all lines"
    left = 2 * MARGIN
    assert drawn[:, left - 1 : left + 128 + GAP + 128 + 1].any()
    assert not drawn[:, left + 129 : left + 128 + GAP - 1].any(), "a margin between two names"


def test_a_name_that_is_too_long_loses_its_middle_but_not_what_tells_it_apart() -> None:
    font = ImageFont.load_default(FONT)
    (first, last) = _headings([f"{'long_' * 30}{end}" for end in ("first", "last")], font, 128)
    assert len(first) == len(last) == HEADING_LINES
    assert "..." in "".join(first)
    assert "".join(first).endswith("_first")
    assert "".join(last).endswith("_last")
    middle = [f"{'x' * 60}{letter}{'x' * 60}" for letter in "ab"]
    assert len(set(map(tuple, _headings(middle, font, 128)))) == 2
    same = _headings([middle[0], f" {middle[0]}"], font, 128)
    assert same[0] == same[1], "names that look alike whole are no reason to go on"


def test_a_grid_with_a_row_of_another_length_or_nothing_in_it_is_refused() -> None:
    with pytest.raises(UnirenderError, match="row 'a': got 1 pictures, expected 2"):
        Grid(("one", "two"), (Line("a", (Tile(colour(0)),)),))
    with pytest.raises(UnirenderError, match="row 'a': got no picture"):
        Grid(("one",), (Line("a", (None,)),))
    with pytest.raises(UnirenderError, match="at least one row"):
        Grid(("one",), ())


@pytest.mark.parametrize(("what", "kept"), [("metallic", "roughness 0.5"), ("roughness", "metallic 0.5")])
def test_a_strip_asks_every_value_and_keeps_the_other(
    suite: Suite, what: Literal["metallic", "roughness"], kept: str
) -> None:
    told, truth = Told(), StoredTruth(suite)
    grid = material_strip(
        [Subject("told", make_row(told, "external")), UNEDITED], suite, suite.scenes[:2], what, (0.0, 0.3), truth
    )
    assert [line.label for line in grid.lines] == ["told", "unedited", "Mitsuba"] * 2
    assert [call[what] for call in told.calls] == [0.0, 0.3] * 2
    assert all("environment" not in call for call in told.calls)
    expected = [(0.0, 0.5), (0.3, 0.5)] if what == "metallic" else [(0.5, 0.0), (0.5, 0.3)]
    assert [material for _, material, _ in truth.asked] == expected * 2
    assert kept in grid.caption
    corners = [tile.corner for tile in grid.lines[1].tiles[1:] if tile is not None]
    assert all(float(corner.removesuffix(" dB")) > 45 for corner in corners), "the input is that truth, but for 8 bits"
    black = [tile.corner for tile in grid.lines[0].tiles[1:] if tile is not None]
    assert all(float(corner.removesuffix(" dB")) < 15 for corner in black), "and black is not"


def test_relighting_takes_lights_that_no_input_has(suite: Suite) -> None:
    told, truth, first = Told(), StoredTruth(suite), suite.scenes[0]
    grid = relighting_grid([Subject("told", make_row(told, "external"))], suite, [first], 4, truth)
    (other,) = other_lights(suite, [first], 4)
    assert other.light != first.light
    np.testing.assert_array_equal(told.calls[0]["environment"], suite.environment(other))
    assert truth.asked == [(first.key, suite.spec.base, float(suite.environment(other).mean()))]
    assert grid.columns == ("input", other.light)
    assert [line.label for line in grid.lines] == ["light", "told", "Mitsuba"]
    with pytest.raises(UnirenderError, match="all 2 lights of suite ball"):
        other_lights(suite, suite.scenes, 4)


def test_the_comparison_asks_the_benchmarks_questions_and_leaves_holes(suite: Suite) -> None:
    grid = comparison_sheet([UNEDITED, ALBEDO], suite, suite.scenes[:1])
    assert grid.columns == ("input", "unedited", "as albedo", "Mitsuba")
    assert [line.label for line in grid.lines] == ["metallic 1", "roughness 0.1", "roughness 0.9", "relit", "albedo"]
    answered = [[tile is not None for tile in line.tiles] for line in grid.lines]
    assert answered == [[True, True, False, True]] * 4 + [[True, False, True, True]]


def test_normals_are_compared_as_colours_by_their_cosine(suite: Suite) -> None:
    facing = Subject("sphere", make_row(SphereNormal(), "trivial"))
    last = comparison_sheet([facing], suite, suite.scenes[:1]).lines[-1]
    assert last.label == "normal"
    tile = last.tiles[1]
    assert tile is not None
    assert 0.9 < float(tile.corner.removeprefix("cos ")) <= 1, "the suite's object is a ball"
    centre = tile.picture.shape[0] // 2
    np.testing.assert_allclose(tile.picture[centre, centre], (0.5, 0.5, 1), atol=0.05)


def test_the_overview_shows_what_a_method_finds_and_the_truth_below(suite: Suite) -> None:
    grid = overview([ALBEDO, UNEDITED], suite, suite.scenes[:1])
    assert [line.label for line in grid.lines] == ["as albedo", "Mitsuba"], "who finds no maps has no row"
    found = dict(zip(grid.columns, grid.lines[0].tiles, strict=True))
    assert [name for name in MAPS if found[name] is not None] == ["albedo"]
    assert found["metallic 1"] is None
    assert all(tile is not None for tile in grid.lines[1].tiles[1:])


def test_a_material_that_is_one_number_has_it_in_its_corner() -> None:
    """Two greys side by side tell nobody 0.30 from 0.35."""
    mask = np.zeros((4, 4, 1), np.float32)
    mask[1:3] = 1
    spread = np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4, 1)
    maps = Intrinsics(roughness=0.35 * mask, metallic=spread, diffuse=np.ones((4, 4, 3), np.float32), mask=mask)
    tiles = dict(zip(MAPS, map_tiles(maps, mask), strict=True))
    corners = {name: tile.corner for name, tile in tiles.items() if tile is not None}
    assert corners == {"roughness": "0.35", "metallic": "", "diffuse": ""}


def test_the_overview_asks_for_the_suites_edits_and_the_scenes_other_light(suite: Suite) -> None:
    class Finds(Told):
        def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
            return Intrinsics(albedo=image_srgb, mask=mask, camera=camera)

    finds, base, scene = Finds(), suite.spec.base, suite.scenes[0]
    overview([Subject("finds", make_row(finds, "external"))], suite, [scene])
    *edited, relit = ({name: call[name] for name in call.keys() - {"mask", "camera"}} for call in finds.calls)
    expected = [(edit.get("metallic", base[0]), edit.get("roughness", base[1])) for edit in edited]
    assert expected == [tuple(edit) for edit in suite.spec.edits]
    assert list(relit) == ["environment"]
    np.testing.assert_array_equal(relit["environment"], suite.environment(suite.other_light(scene)))


def test_the_light_figure_shows_balls_with_the_errors_of_the_tables(suite: Suite) -> None:
    found = Subject("mean light", make_row(MeanLight(), "trivial"))
    grid = light_figure([found, UNEDITED], suite, suite.scenes[:2])
    assert [line.label for line in grid.lines] == ["mean light", "true light"] * 2
    assert grid.columns == ("input", "matte ball", "glossy ball", "mirror ball")
    light = MeanLight().decompose(np.ones((4, 4, 3), np.float32), np.ones((4, 4, 1), np.float32), suite.spec.camera)
    assert light.environment is not None
    errors = ball_values(light.environment, suite.environment(suite.scenes[0]))
    corners = [tile.corner for tile in grid.lines[0].tiles if tile is not None]
    assert corners == ["", *(f"{errors[f'ball_{name}.rmse_relative@aligned']:.2f}" for name in ("matte", "glossy")), ""]
    assert grid.lines[1].tiles[0] is None
    for name in (0, 2):  # each scene under its own light, and one light for all
        assert not np.array_equal(shown(grid, name + 1), shown(grid, (name + 3) % 4))
    assert np.array_equal(shown(grid, 0), shown(grid, 2))
    with pytest.raises(UnirenderError, match=r"light: as albedo finds none; leave it out"):
        light_figure([ALBEDO], suite, suite.scenes[:1])


def shown(grid: Grid, line: int) -> np.ndarray:
    tile = grid.lines[line].tiles[1]
    assert tile is not None
    return tile.picture


def test_a_stranger_that_returns_none_leaves_holes(suite: Suite) -> None:
    """As it leaves numbers out of the tables."""

    class Silent:
        name, config = "silent", {"weights": None}

        def decompose(self, **_: Any) -> None:
            return None

        edit = relight = render = decompose

    subjects, scenes = [Subject("silent", make_row(Silent(), "external"))], [suite.scenes[0]]
    truth = StoredTruth(suite)
    grids = [
        material_strip(subjects, suite, scenes, "metallic", (0.0, 1.0), truth),
        relighting_grid(subjects, suite, scenes, 2, truth),
        overview(subjects, suite, scenes),
    ]
    for grid in grids:
        (line,) = (line for line in grid.lines if line.label == "silent")
        assert line.tiles[0] is not None
        assert set(line.tiles[1:]) == {None}
    with pytest.raises(UnirenderError, match="silent finds none"):
        light_figure(subjects, suite, scenes)


def test_a_figure_that_no_method_can_fill_is_refused_by_name(suite: Suite) -> None:
    with pytest.raises(UnirenderError, match=r"metallic strip: got as albedo, of which none can edit; .* --kinds"):
        material_strip([ALBEDO], suite, suite.scenes[:1], "metallic", (0.5,), StoredTruth(suite))
    with pytest.raises(UnirenderError, match="overview: got unedited, of which none can decompose"):
        overview([UNEDITED], suite, suite.scenes[:1])


def test_the_truth_of_an_object_that_is_made_otherwise_here_is_refused(suite: Suite) -> None:
    scene = suite.scenes[0]
    with pytest.raises(UnirenderError, match=r"ball-0: got another object .* suite ball .*geometry FAILED on"):
        MitsubaTruth(suite, 8)(scene, suite.spec.base, suite.environment(scene))


@pytest.mark.slow
def test_the_rendered_truth_is_the_suites_own_within_its_noise() -> None:
    """And that of another metallic value is not."""
    tiny = load_suite("tiny")
    scene, base = tiny.scenes[0], tiny.spec.base
    truth, environment = MitsubaTruth(tiny, 256), tiny.environment(tiny.scenes[0])
    stored = tiny.image(scene, base)
    errors = [float(np.abs(truth(scene, m, environment) - stored).mean()) for m in (base, (1.0, base[1]))]
    assert errors[0] < 0.01, f"mean difference {errors[0]:.4f} at 256 samples per pixel (threshold 0.01)"
    assert errors[1] > 2 * errors[0], "the twin"


def test_default_scenes_come_from_both_halves_and_labels_are_unique() -> None:
    tiny = load_suite("tiny")
    chosen = [tiny.scenes.index(scene) for scene in default_scenes(tiny)]
    assert chosen == [12, 36]
    assert labels((Path("a/x"), Path("a/y"))) == ["x", "y"]
    assert labels((Path("a/x"), Path("b/x"))) == ["a/x", "b/x"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"values": (0.5, 1.5)}, r"--values 0.5 1.5: expected at least one number, all in \[0, 1\]"),
        ({"values": ()}, "expected at least one number"),
        ({"values": (0.5, 0.5)}, "none of them twice"),
        ({"kinds": ()}, "--kinds: expected at least one of metallic"),
        ({"scenes": ("a", "a")}, "--scenes a a"),
        ({"lights": 0}, "--lights 0"),
        ({"spp": 0}, "--spp 0"),
    ],
)
def test_what_cannot_be_drawn_is_a_usage_error(options: dict, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        Figures(**options).run()


def test_every_option_reaches_the_figures(suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with a value that is not its default."""
    drawn, loaded = dict[str, tuple](), list[ModelOptions]()
    for module, name in (
        (panels, "material_strip"),
        (panels, "relighting_grid"),
        (panels, "comparison_sheet"),
        (overview_module, "overview"),
        (light_module, "light_figure"),
    ):
        monkeypatch.setattr(module, name, lambda *given, name=name: drawn.update({f"{name} {given[3:4]}": given}))
    monkeypatch.setattr(grid_module, "save", lambda _, path: replace_file(path, ""))
    monkeypatch.setattr(ModelOptions, "load", lambda options: loaded.append(options))
    figures = Figures(
        tmp_path, (Path("small"), Path("tiny")), (), str(suite.spec.path), (suite.scenes[3].key,),
        kinds=ASKED, values=(0.0, 0.3), lights=1, spp=8, device="auto",
    )  # fmt: skip
    assert figures.run() == 0
    assert {path.stem for path in tmp_path.iterdir()} == set(ASKED)
    assert [options.checkpoint for options in loaded] == [checkpoint_folder(name) for name in figures.checkpoint]
    assert {options.device for options in loaded} == {"auto"}
    for subjects, of, scenes, *_ in drawn.values():
        assert [subject.label for subject in subjects] == ["small", "tiny"]
        assert {subject.row.config["anchored"] for subject in subjects} == {True}
        assert subjects[0].row.config["weights"] == checkpoint_sha256(checkpoint_folder(Path("small")))
        assert (of.sha256, [scene.key for scene in scenes]) == (suite.sha256, [suite.scenes[3].key])
    for what in ("metallic", "roughness"):
        *_, values, truth = drawn[f"material_strip ('{what}',)"]
        assert (values, truth.spp) == ((0.0, 0.3), MitsubaTruth(suite, 8).spp)
    *_, count, truth = drawn["relighting_grid (1,)"]
    assert (count, truth.spp) == (1, MitsubaTruth(suite, 8).spp)


def test_fewer_lights_than_were_asked_for_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    tiny = load_suite("tiny")
    assert len(Figures(lights=2).relit_by(tiny, tiny.scenes[:1])) == 2
    assert not capsys.readouterr().err
    there = len(Figures(lights=1000).relit_by(tiny, tiny.scenes[:1]))
    assert f"--lights 1000: suite tiny has {there} that light no input, and all of them" in capsys.readouterr().err


def test_an_unknown_scene_or_checkpoint_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="has no scene 'none'"):
        Figures(out=tmp_path / "out", scenes=("none",)).run()
    with pytest.raises(UnirenderError, match="nowhere"):
        Figures(out=tmp_path / "out", checkpoint=(tmp_path / "nowhere",)).run()
    assert not (tmp_path / "out").exists()


def test_the_command_draws_a_strangers_method_without_our_model(tmp_path: Path, suite: Suite) -> None:
    (tmp_path / "theirs.py").write_text(
        "class Theirs:\n"
        "    name, config = 'theirs', {'theirs': 1}\n"
        "    def decompose(self, image_srgb, mask, camera):\n"
        "        from unirender import Intrinsics\n"
        "        return Intrinsics(albedo=image_srgb, mask=mask, camera=camera)\n"
    )
    method = (f"{tmp_path / 'theirs.py'}:Theirs",)
    figures = Figures(out=tmp_path / "out", suite=str(suite.spec.path), kinds=("comparison",), method=method)
    assert figures.run() == 0
    assert Image.open(tmp_path / "out" / "comparison.png").width > 3 * SIZE
    (subject,) = figures.subjects()
    assert subject.label == "theirs"
    assert subject.can("decompose")
    assert not subject.can("edit")


def test_where_none_is_named_the_checkpoint_is_the_one_for_the_suites_pictures() -> None:
    for suite, name in (("tiny", "tiny"), ("standard", "small")):
        (subject,) = Figures(suite=suite).subjects()
        assert subject.label == name


def test_the_command_is_light_to_import() -> None:
    code = "import sys, unirender_evaluation.figures.command; print({'torch', 'mitsuba', 'PIL'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
