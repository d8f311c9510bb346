"""Lights: normalisation, orientation, splits, the photograph rule, files."""

import re
import tracemalloc
from functools import partial

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from unirender.color import luminance
from unirender.errors import UnirenderError
from unirender.exr import image_channels, write_exr
from unirender.light.environment import environment_directions, mean_radiance, sample_environment, texel_solid_angles
from unirender_reference import lights
from unirender_reference.lights import photograph
from unirender_reference.lights.convert import PACKAGES, convert
from unirender_reference.lights.light import area_resampled


def mean_luminance(environment: np.ndarray) -> float:
    return float(luminance(mean_radiance(environment)[None])[0])


@pytest.mark.parametrize("kind", [lights.light_gradient, lights.light_softboxes, lights.light_sunsky])
def test_synthetic_lights_are_normalised(kind):
    assert mean_luminance(kind(3).environment) == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize("split", ["train", "test"])
def test_make_light_repeats_and_is_normalised(split):
    for seed in range(25):
        light = lights.make_light(seed, split)
        assert light.environment.shape == (64, 128, 3)
        assert mean_luminance(light.environment) == pytest.approx(1, rel=1e-4)
        assert light.name.startswith(f"{split}-{seed:06d}-")
        np.testing.assert_array_equal(light.environment, lights.make_light(seed, split).environment)


# Seed of `train` -> mean direction by luminance, and mean color: one light of each kind, and a tilted one.
OF_SEED = {
    0: ((-0.190, 0.291, 0.063), (1.046, 0.995, 0.912)),  # bundled
    1: ((0.518, 0.348, 0.291), (0.835, 1.008, 1.406)),  # softboxes
    3: ((0.152, 0.226, 0.091), (0.822, 1.016, 1.366)),  # sunsky
    13: ((-0.097, 0.466, 0.478), (0.932, 1.002, 1.176)),  # bundled, tilted
    15: ((0.091, 0.043, 0.322), (1.220, 0.955, 0.797)),  # gradient
    65: ((0.000, 0.000, 0.000), (1.287, 0.949, 0.660)),  # constant
}


@pytest.mark.parametrize("seed", OF_SEED)
def test_the_light_of_a_seed_is_what_it_was(seed):
    """A data set says no more of a light than its seed."""
    environment = lights.make_light(seed, "train").environment
    direction, color = OF_SEED[seed]
    weight = texel_solid_angles(64, 128) * luminance(environment)
    found = np.einsum("hw,hwc->c", weight, environment_directions(64, 128)) / weight.sum()
    np.testing.assert_allclose(found, direction, rtol=0, atol=1e-3)
    np.testing.assert_allclose(mean_radiance(environment), color, rtol=0, atol=1e-3)


def test_shares_of_kinds_and_disjoint_pools():
    drawn = {split: [lights.make_light(seed, split) for seed in range(80)] for split in ("train", "test")}
    maps = {}
    for split, made in drawn.items():
        kinds = [light.provenance["kind"] for light in made]
        assert 0.35 < kinds.count("bundled") / 80 < 0.65
        assert 0.10 < kinds.count("softboxes") / 80 < 0.40
        assert 0.04 < kinds.count("sunsky") / 80 < 0.30
        maps[split] = {light.name.split("-", 2)[2] for light in made if light.provenance["kind"] == "bundled"}
        assert maps[split] <= {light.name for light in lights.bundled_lights(split)}
    assert not maps["train"] & maps["test"]
    # bundled maps may meet again at the same turn, constants at the same colour; procedural lights never
    procedural = [
        light.environment.tobytes()
        for made in drawn.values()
        for light in made
        if light.provenance["kind"] in ("softboxes", "gradient", "sunsky")
    ]
    assert len(set(procedural)) == len(procedural)


def test_catalogue_names_26_maps_and_keeps_twins_together():
    rows = lights.catalogue()
    assert len(rows) == 26
    assert len(lights.bundled_lights("test")) == 8
    assert len(lights.bundled_lights("train")) == 18
    assert len(lights.bundled_lights()) == 26
    for twin in ("city", "forest", "night", "studio", "sunrise", "sunset"):
        assert rows[f"pmndrs-{twin}"]["split"] == rows[f"blender-{twin}"]["split"]
    for row in rows.values():
        assert row["license"] == "CC0-1.0"
        assert len(row["source_sha256"]) == 64
    for light in lights.bundled_lights():
        assert light.environment.shape == (64, 128, 3)
        assert mean_luminance(light.environment) == pytest.approx(1, rel=1e-4)
    with pytest.raises(UnirenderError, match="expected one of"):
        lights.bundled_light("nowhere")


def test_sky_is_above_and_the_sun_is_where_it_says():
    directions = environment_directions(64, 128)
    for seed in range(8):
        light = lights.light_sunsky(seed)
        energy = luminance(light.environment)
        brightest = directions.reshape(-1, 3)[energy.argmax()]
        if float(light.provenance["sun_scale"]) == 1.0:
            elevation = np.degrees(np.arcsin(brightest[1]))
            assert elevation == pytest.approx(float(light.provenance["elevation_deg"]), abs=6)
        ground = light.environment[34:]
        assert np.ptp(ground.reshape(-1, 3), axis=0).max() < 1e-4 * ground.max() + 1e-6  # one Lambertian plane
        irradiance = (energy * np.maximum(directions[..., 1], 0) * texel_solid_angles(64, 128)).sum()
        albedo = luminance(ground[10, :1])[0] * np.pi / irradiance
        assert 0.02 < albedo < 0.7


def test_area_resampling_keeps_energy_and_directions():
    rng = np.random.default_rng(0)
    picture = rng.uniform(0, 1, (128, 256, 3)).astype(np.float32)
    theta = (np.arange(128) + 0.5) * np.pi / 128
    exact = np.cos(theta - np.pi / 256) - np.cos(theta + np.pi / 256)
    mean = (picture * (exact / exact.sum() / 256)[:, None, None]).sum((0, 1))
    assert mean_radiance(area_resampled(picture, (32, 64))) == pytest.approx(mean, rel=2e-4)
    # a smooth function of direction is found again in that direction, at the same size and smaller
    phi = (np.arange(256) + 0.5) / 256 * 2 * np.pi
    x = np.sin(theta)[:, None] * np.sin(phi)[None]
    smooth = np.stack([1 + 0.5 * x, 1 + 0.5 * np.broadcast_to(np.cos(theta)[:, None], x.shape), np.ones_like(x)], -1)
    for shape in ((128, 256), (32, 64)):
        found = sample_environment(area_resampled(smooth.astype(np.float32), shape), np.eye(3, dtype=np.float32)[:2])
        assert found[:, :2] == pytest.approx(np.array([[1.5, 1.0], [1.0, 1.5]]), abs=0.01)


@pytest.mark.parametrize("size", [(8, 16), (64, 128), (50, 100), (128, 256), (300, 600)])
def test_area_resampling_keeps_the_energy_of_a_sun_in_any_row(size):
    """One pixel of the first or last row lost up to 2.5 %."""
    height, width = size
    theta = np.arange(height + 1) * np.pi / height
    solid_angles = -np.diff(np.cos(theta)) * 2 * np.pi / width
    assert np.abs(area_resampled(np.ones((*size, 3), np.float32), (64, 128)) - 1).max() < 1e-6
    for row, column in ((0, 0), (1, width // 3), (height // 2, width - 1), (height - 1, 5)):
        sun = np.zeros((*size, 3), np.float32)
        sun[row, column] = 1e3
        expected = 1e3 * solid_angles[row] / (4 * np.pi)
        assert mean_radiance(area_resampled(sun, (64, 128))) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    "pixels",
    [np.full((8, 16, 3), np.nan), np.ones((0, 16, 3))],
    ids=["NaN", "empty"],
)
def test_a_picture_that_is_no_radiance_is_not_resampled(pixels):
    with pytest.raises(UnirenderError, match=r"^light: got .*, expected "):
        area_resampled(pixels, (8, 16))


@pytest.mark.parametrize(("rows", "row"), [(2, 0), (5, 1), (16, 0)])
def test_a_lamp_of_a_coarse_map_stays_where_it_is(tmp_path, rows, row):
    """On a grid of the map's own rows it had half of its radiance, and those of 5 rows stood 3 degrees off, at the
    pole of 16 rows 3.4; a map of 2 x 4 pixels could not be rendered by.
    """
    pixels = np.zeros((rows, 2 * rows, 3), np.float32)
    pixels[row, 1] = 8
    write_exr(tmp_path / "a.exr", image_channels(pixels), half=False)
    environment = lights.load_light(tmp_path / "a.exr", normalise=False).environment
    assert environment.max() > 0.99 * pixels.max()
    at = area_resampled(pixels, (256, 512))
    np.testing.assert_allclose(_moments(environment), _moments(at), rtol=0, atol=5e-3 * _moments(at)[0])


def _moments(environment):
    """Power of a light, and its first moments along x, y and z."""
    radiance = environment[..., 0] * texel_solid_angles(*environment.shape[:2])
    return radiance.sum(), *np.einsum("hw,hwc->c", radiance, environment_directions(*environment.shape[:2]))


@pytest.mark.parametrize("shape", [(0, 0), (1, 4)])
def test_a_shape_that_is_none_is_refused(tmp_path, shape):
    """Of no rows or of one, memory was written beside the arrays, and the process died."""
    write_exr(tmp_path / "a.exr", image_channels(np.ones((8, 16, 3), np.float32)), half=False)
    for made in (lights.load_light, partial(lights.load_light, photograph=True)):
        with pytest.raises(UnirenderError, match="expected a lat-long map of at least 2 x 2 texels"):
            made(tmp_path / "a.exr", shape=shape)


def test_exr_and_rgbe_maps_agree(tmp_path):
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0.1, 4, (16, 32, 3)).astype(np.float32)
    write_exr(tmp_path / "map.exr", image_channels(pixels), half=False)
    # flat RGBE: mantissas of 8 bits under a common exponent
    exponent = np.floor(np.log2(pixels.max(-1))) + 1
    mantissa = np.floor(pixels / 2.0 ** (exponent[..., None] - 8)).astype(np.uint8)
    rgbe = np.concatenate([mantissa, (exponent[..., None] + 128).astype(np.uint8)], -1)
    (tmp_path / "map.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n" + rgbe.tobytes())
    exr, hdr = lights.load_light(tmp_path / "map.exr"), lights.load_light(tmp_path / "map.hdr")
    assert exr.environment.shape == (64, 128, 3)
    assert exr.provenance["rule"] == "lat-long"
    assert hdr.environment == pytest.approx(exr.environment, abs=0.03)
    assert lights.load_light(tmp_path / "map.exr", shape=(8, 16)).environment.shape == (8, 16, 3)


RADIANCE = b"#?RADIANCE\n%bFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n" + bytes([128, 128, 128, 129]) * 512  # all 1


@pytest.mark.parametrize(
    ("lines", "radiance"),
    [
        (b"", (1, 1, 1)),
        (b"EXPOSURE=2\n", (0.5, 0.5, 0.5)),
        (b"EXPOSURE = 2\n", (0.5, 0.5, 0.5)),
        (b"EXPOSURE= 2.0e+00\nEXPOSURE=0.25\n", (2, 2, 2)),
        (b"COLORCORR=1 2 4\nEXPOSURE=0.5\nCOLORCORR=1 1 2\n", (2, 1, 0.25)),
        (b"\tEXPOSURE=2\nSOFTWARE=EXPOSURE=2\n", (1, 1, 1)),  # of a picture that it was made of; of something else
    ],
)
def test_a_radiance_header_says_what_the_pixels_were_multiplied_by(tmp_path, lines, radiance):
    path = bad_file(tmp_path, "map.hdr", RADIANCE % lines)
    found = lights.load_light(path, normalise=False).environment
    np.testing.assert_allclose(found, np.broadcast_to(np.float32(radiance), found.shape), rtol=1e-6)


PRIMARIES = b"PRIMARIES=%b\n"


@pytest.mark.parametrize(
    ("primaries", "radiance"),
    [
        (b"0.708 0.292 0.17 0.797 0.131 0.046 0.3127 0.329", (1.165, 0.719, 0.745)),  # by the matrix of ITU-R BT.2087
        (b"0.640 0.330 0.300 0.600 0.150 0.060 0.3127 0.3290", (1, 0.75, 0.75)),
        (b"0 0 0 0 0 0 0 0", (1, 0.75, 0.75)),  # as Photoshop writes it
    ],
)
def test_a_radiance_header_says_what_its_colours_are(tmp_path, primaries, radiance):
    """They were taken for those of Rec.709."""
    white = RADIANCE % (PRIMARIES % primaries)
    pink = white.replace(bytes([128, 128, 128, 129]), bytes([128, 96, 96, 129]))
    for data, expected in ((white, (1, 1, 1)), (pink, radiance)):
        found = lights.load_light(bad_file(tmp_path, "map.hdr", data), normalise=False).environment
        np.testing.assert_allclose(found, np.broadcast_to(np.array(expected, np.float32), found.shape), atol=1e-3)


def test_area_resampling_of_a_large_picture_costs_little_memory():
    picture = np.ones((1024, 2048, 3), np.float32)
    tracemalloc.start()
    same = area_resampled(picture, (1024, 2048))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    np.testing.assert_allclose(same, 1, rtol=1e-6)


@pytest.mark.parametrize("photograph", [False, True])
def test_scale_of_a_file_is_recorded_or_kept(tmp_path, photograph):
    rng = np.random.default_rng(0)
    pixels = rng.uniform(1, 7, (16, 32, 3)).astype(np.float32)
    write_exr(tmp_path / "map.exr", image_channels(pixels), half=False)
    kept = lights.load_light(tmp_path / "map.exr", photograph, normalise=False)
    scaled = lights.load_light(tmp_path / "map.exr", photograph)
    assert kept.environment.shape == ((128, 256, 3) if photograph else (64, 128, 3))
    assert kept.provenance["scale"] == "1.0"
    scale = float(scaled.provenance["scale"])
    np.testing.assert_allclose(scaled.environment, kept.environment * scale, rtol=1e-6)
    assert mean_luminance(scaled.environment) == pytest.approx(1, rel=1e-4)
    assert scale == pytest.approx(1 / mean_luminance(kept.environment), rel=1e-6)
    assert scale < 0.5


def test_a_constant_file_keeps_its_radiance(tmp_path):
    write_exr(tmp_path / "map.exr", image_channels(np.full((16, 32, 3), 2.5, np.float32)))
    np.testing.assert_allclose(lights.load_light(tmp_path / "map.exr", normalise=False).environment, 2.5, rtol=1e-6)
    Image.fromarray(np.full((90, 180, 3), 255, np.uint8)).save(tmp_path / "white.png")
    assert lights.load_light(tmp_path / "white.png", normalise=False).environment.max() == pytest.approx(
        photograph.PEAK
    )


def test_grey_exr_is_white_light(tmp_path):
    grey = np.linspace(0.5, 1, 32, dtype=np.float32)[None].repeat(16, 0)
    write_exr(tmp_path / "grey.exr", {"Y": grey})
    e = lights.load_light(tmp_path / "grey.exr").environment
    np.testing.assert_array_equal(e, e[..., :1].repeat(3, -1))


def test_the_brightest_floats_are_scaled(tmp_path):
    write_exr(tmp_path / "map.exr", image_channels(np.full((16, 32, 3), 3e38, np.float32)), half=False)
    light = lights.load_light(tmp_path / "map.exr")
    np.testing.assert_allclose(light.environment, 1, rtol=1e-5)


def test_negative_lobes_are_counted(tmp_path):
    pixels = np.ones((16, 32, 3), np.float32)
    pixels[8, 10] = -3
    write_exr(tmp_path / "map.exr", image_channels(pixels))
    light = lights.load_light(tmp_path / "map.exr")
    assert light.environment.min() == 0
    assert float(light.provenance["negative_share"]) > 0


def test_photograph_range_rule():
    ramp = np.linspace(0, 1, 101)[None, :, None].repeat(3, -1).astype(np.float32)
    expanded = photograph.expand_range(ramp)[0, :, 0]
    below = ramp[0, :, 0] <= photograph.KNEE
    np.testing.assert_allclose(expanded[below], ramp[0, below, 0], rtol=1e-6)
    assert expanded[-1] == pytest.approx(photograph.PEAK)
    assert (np.diff(expanded) > 0).all()
    colored = photograph.expand_range(np.array([[[1.0, 0.5, 0.25]]], np.float32))[0, 0]
    assert colored / colored[0] == pytest.approx([1, 0.5, 0.25])


def test_photograph_on_the_sphere(tmp_path):
    picture = np.full((90, 180, 3), 96, np.uint8)
    picture[:, :60, 0] = 200  # left third red
    picture[:10, :, 2] = 220  # top edge blue
    picture[-10:, :, 1] = 20
    Image.fromarray(picture).save(tmp_path / "photo.png")
    light = lights.load_light(tmp_path / "photo.png")
    assert light.environment.shape == (128, 256, 3)
    assert lights.load_light(tmp_path / "photo.png", shape=(16, 32)).environment.shape == (16, 32, 3)
    assert "photograph" in light.provenance["rule"]
    e = light.environment
    np.testing.assert_allclose(e, e[:, ::-1][:, (np.arange(256) + 128) % 256], atol=0.05 * e.max())  # mirror at +-x

    def seen(direction):
        return sample_environment(e, np.array([direction], np.float32))[0]

    front = seen([0, 0, 1])
    assert front[0] == pytest.approx(front[1], rel=1e-3)  # grey middle behind the camera
    red_side = seen([-0.7, 0, 0.7]), seen([0.7, 0, 0.7])
    assert (red_side[0][0] > 1.5 * red_side[0][1]) != (red_side[1][0] > 1.5 * red_side[1][1])
    up = seen([0, 1, 0])
    assert up[2] > 2 * up[1]  # the sky goes on with the top edge
    panorama = lights.load_light(tmp_path / "photo.png", photograph=False)
    assert panorama.environment.shape == (90, 180, 3)
    assert panorama.provenance["rule"] == "lat-long"


@pytest.mark.parametrize(("row", "column"), [(0.3, 0.15), (0.5, 0.5), (0.75, 0.8)])
def test_a_photograph_spans_180_degrees_of_the_horizon_and_45_up_and_down(row, column):
    """A spot at a share of the picture's height and width; its mirror image lies in the other half."""
    picture = np.zeros((100, 200, 3), np.float32)
    top, left = round(100 * row), round(200 * column)
    picture[top - 3 : top + 3, left - 3 : left + 3] = 1
    environment = photograph.photograph_environment(picture, (64, 128))
    directions = environment_directions(64, 128)
    energy = environment.sum(-1) * texel_solid_angles(64, 128) * (directions[..., 2] > 0)
    x, y, z = (energy[..., None] * directions).sum((0, 1))
    assert np.degrees(np.arctan2(x, z)) == pytest.approx(180 * (0.5 - column), abs=1)
    assert np.degrees(np.arctan2(y, np.hypot(x, z))) == pytest.approx(90 * (0.5 - row), abs=1)


def test_of_a_tall_photograph_the_middle_is_taken():
    picture = np.full((200, 100, 3), 5, np.float32)
    picture[75:125] = 1  # 90 degrees high where the width is 180
    assert photograph.photograph_environment(picture, (64, 128)).max() == pytest.approx(1)


def test_beyond_a_photograph_its_edge_fades_over_30_degrees_to_its_mean():
    """Left half white, right half black; the floor is darkened as it fades."""
    picture = np.zeros((100, 200, 3), np.float32)
    picture[:, :100] = 1
    environment = photograph.photograph_environment(picture, (64, 128))
    for elevation, faded in ((50, 1 / 6), (60, 0.5), (70, 5 / 6), (80, 1)):
        for side, edge in ((1, 1), (-1, 0)):  # left is +x
            for up, light in ((1, 1), (-1, 1 - (1 - photograph.FLOOR) * faded)):
                horizontal, y = np.cos(np.radians(elevation)), up * np.sin(np.radians(elevation))
                direction = np.array([side * horizontal / np.sqrt(2), y, horizontal / np.sqrt(2)])
                expected = (edge * (1 - faded) + 0.5 * faded) * light
                seen = sample_environment(environment, direction[None].astype(np.float32))[0]
                assert seen == pytest.approx(expected, abs=0.02), (elevation, side, up)


def test_a_phones_photograph_is_turned_upright(tmp_path):
    """Its pixels lie on the side, and EXIF orientation 6 says: turn a quarter clockwise to see it."""
    upright = np.random.default_rng(0).integers(0, 256, (90, 180, 3), np.uint8)
    Image.fromarray(upright).save(tmp_path / "upright.png")
    lying, exif = Image.fromarray(np.rot90(upright, 1)), Image.Exif()
    exif[0x0112] = 6
    lying.save(tmp_path / "phone.png", exif=exif)
    lying.save(tmp_path / "sideways.png")
    maps = {name: lights.load_light(tmp_path / f"{name}.png").environment for name in ("upright", "phone", "sideways")}
    np.testing.assert_array_equal(maps["phone"], maps["upright"])
    assert np.abs(maps["sideways"] - maps["upright"]).max() > 0.1


def test_16_bit_grey_keeps_its_range(tmp_path):
    grey = np.linspace(0, 65535, 180).round().astype(np.uint16)[None].repeat(90, 0)
    Image.fromarray(grey).save(tmp_path / "deep.png")
    Image.fromarray((grey / 257).round().astype(np.uint8)).save(tmp_path / "eight.png")
    deep, eight = (
        lights.load_light(tmp_path / f"{name}.png", normalise=False).environment for name in ("deep", "eight")
    )
    np.testing.assert_allclose(deep, eight, rtol=0.02, atol=0.1)  # 8 bits: half a step of 1/255 near white is 7 %
    assert np.median(deep) < 0.5


def test_alpha_of_a_photograph_is_dropped(tmp_path):
    rgba = np.random.default_rng(0).integers(0, 256, (90, 180, 4), np.uint8)
    Image.fromarray(rgba).save(tmp_path / "alpha.png")
    Image.fromarray(np.ascontiguousarray(rgba[..., :3])).save(tmp_path / "plain.png")
    alpha, plain = (lights.load_light(tmp_path / f"{name}.png").environment for name in ("alpha", "plain"))
    np.testing.assert_array_equal(alpha, plain)


def bad_file(tmp_path, name: str, data: bytes):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


ONES = np.ones((16, 32, 3), np.float32)
NOT_FINITE = np.where(np.arange(512).reshape(16, 32) == 100, np.nan, 1).astype(np.float32)  # row 3, column 4
REFUSED = {  # file -> bytes, the channels of an EXR or a picture; what is said of it
    "absent.hdr": (None, r"no such file, .*unirender lights --export FOLDER"),
    ".": (None, "is a folder, expected an HDR"),
    "text.png": (b"hello", "not a readable picture"),
    "text.hdr": (b"hello", "not a readable"),
    "text.exr": (b"hello", "not a readable"),
    "picture.hdr": (Image.fromarray(np.full((16, 32, 3), 128, np.uint8)), "is a PNG under another name, expected rad"),
    "large.png": (Image.new("1", (12000, 10000)), "expected at most"),
    "bomb.png": (Image.new("1", (20000, 10000)), "decompression bomb"),
    "square.exr": (image_channels(ONES[:, :16]), r"is a PNG or JPG file \(in Python .*photograph=True"),
    "black.exr": (image_channels(0 * ONES), "not black"),
    "negative.exr": (image_channels(np.where(np.arange(32)[:, None] < 8, -ONES, ONES)), "25% of the radiance is neg"),
    "nan.exr": (dict.fromkeys("RGB", NOT_FINITE), r"1 of 512 pixels are NaN .*\(the first in row 3, column 4,"),
    "inf.exr": (dict.fromkeys("RGB", np.nan_to_num(NOT_FINITE, nan=np.inf)), "1 of 512 pixels are NaN or infinite"),
    "nan.pfm": (b"PF\n4 2\n1.0\n" + np.array([np.nan] + 23 * [1], ">f4").tobytes(), r"1 of 8 .*row \d, column 0"),
    **{
        f"{name}.exr": (dict.fromkeys(name.split("_"), ONES[..., 0]), "got EXR channels .*expected R, G, B, or Y alone")
        for name in ("Y_RY_BY", "Z", "X_Y_Z")
    },
    **{
        f"{i}.hdr": ((RADIANCE % b"").replace(b"-Y 16 +X 32", order), f"stored as '{re.escape(order.decode())}', expec")
        for i, order in enumerate((b"+Y 16 +X 32", b"-Y 16 -X 32", b"+X 32 -Y 16"))
    },
    **{
        f"{line.decode()}.hdr": (RADIANCE % (line + b"\n"), f"its header has '{line.decode()}', expected ")
        for line in (
            *(b"EXPOSURE=0", b"EXPOSURE=", b"EXPOSURE=nan", b"COLORCORR=1 1", b"COLORCORR=1 -1 1", b"PRIMARIES=1 2"),
        )
    },
    "xyz.hdr": ((RADIANCE % b"").replace(b"rle_rgbe", b"rle_xyze"), "got 32-bit_rle_xyze, expected RGB"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_is_no_light_is_refused_with_the_reason(tmp_path, name):
    content, message = REFUSED[name]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):  # our own writer refuses what is not finite
        channels = {channel: np.ascontiguousarray(values) for channel, values in content.items()}
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels).write(str(path))
    elif content is not None:
        content.save(path, "PNG")
    with pytest.raises(UnirenderError, match=rf"{re.escape(str(path))}.*{message}"):
        lights.load_light(path)


def test_errors_say_what_to_do():
    with pytest.raises(UnirenderError, match="expected seed >= 0"):
        lights.make_light(-1, "train")
    with pytest.raises(UnirenderError, match="three finite numbers"):
        lights.light_constant((1.0, -1.0, 0.0))


def test_bundled_maps_are_the_callers_own():
    first = lights.bundled_light("pmndrs-city")
    first.environment[:] = 0  # Mitsuba refuses read-only arrays; writing must not reach the next caller
    assert mean_luminance(lights.bundled_light("pmndrs-city").environment) == pytest.approx(1, rel=1e-4)


def test_conversion_repeats_and_refuses_other_sources(tmp_path):
    rng = np.random.default_rng(0)
    for package in PACKAGES:
        (tmp_path / "source" / package).mkdir(parents=True)
        pixels = rng.uniform(0, 2, (32, 64, 3)).astype(np.float32)
        write_exr(tmp_path / "source" / package / "city.exr", image_channels(pixels))
    (tmp_path / "target").mkdir()
    convert(tmp_path / "source", tmp_path / "target")
    first = {path.name: path.read_bytes() for path in (tmp_path / "target").iterdir()}
    assert set(first) == {"pmndrs-city.exr", "blender-city.exr", "lights.toml"}
    convert(tmp_path / "source", tmp_path / "target")
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "target").iterdir()}
    write_exr(tmp_path / "source" / "blender" / "city.exr", image_channels(np.ones((32, 64, 3), np.float32)))
    with pytest.raises(UnirenderError, match="sha256"):
        convert(tmp_path / "source", tmp_path / "target")
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "target").iterdir()}  # nothing half done
