"""What the demo does without a browser: uploads and their limits, edits and lights, Mitsuba's check, archives, HTML."""

import asyncio
import base64
import dataclasses
import io
import json
import socket
import struct
import sys
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo_files import ball, nan_exr, png, radiance
from PIL import Image
from tiny_models import make_pipeline

from unirender.cli import main
from unirender.command_line.input_picture import BYTES_OF_NONE
from unirender.errors import UnirenderError, UsageError
from unirender.exr import exr_bytes, image_channels
from unirender.files import read_result
from unirender.intrinsics import Intrinsics
from unirender.pictures import Picture
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender_evaluation.demo import jobs, panels, server, session
from unirender_evaluation.demo.address import check_address
from unirender_evaluation.demo.command import Demo
from unirender_evaluation.demo.downloads import archives
from unirender_evaluation.demo.session import Controls, Subject
from unirender_evaluation.demo.uploads import (
    LIGHT_SHAPE,
    Limits,
    Upload,
    pixel_size,
    read_light,
    read_upload,
    square,
)
from unirender_evaluation.metrics import METRICS, metric_key
from unirender_evaluation.scoring import score_image

LIMITS = Limits(megabytes=1, pixels=1_000_000, seconds=60)
SIZE = 32


def upload(name: str = "ball.png", picture: Picture | None = None) -> Upload:
    picture = picture or ball()
    assert picture.mask is not None
    return Upload(name, png(np.concatenate([picture.image_srgb, picture.mask], axis=-1)))


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return make_pipeline(0)


@pytest.fixture(scope="module")
def subject(pipeline: UniRenderPipeline) -> Subject:
    return session.take_apart(pipeline, ball())


def png_head(width: int, height: int) -> bytes:
    """A PNG that says it is that large, and has no pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    check = struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + check + struct.pack(">I", 9) + b"IDAT"


@pytest.mark.parametrize(
    ("name", "data", "size"),
    [
        ("a.png", png(np.zeros((5, 9, 3))), (9, 5)),
        ("a.png", png_head(20_000, 8_000), (20_000, 8_000)),
        ("a.exr", radiance(1.0, (8, 16)), (16, 8)),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4096 +X 8192\n\x02", (8192, 4096)),
        ("a.pfm", b"PF\n640 480\n-1.0\n\x00", (640, 480)),
        ("a.png", b"no picture", None),
        ("a.exr", b"no picture", None),
    ],
    ids=["png", "large png", "exr", "hdr", "pfm", "no png", "no exr"],
)
def test_the_size_of_a_picture_is_known_without_decoding_it(
    name: str, data: bytes, size: tuple[int, int] | None
) -> None:
    assert pixel_size(Upload(name, data)) == size


def test_an_upload_is_deleted_when_it_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "ball.png"
    path.write_bytes(upload().data)
    assert Upload.take(path) == upload()
    assert not path.exists()
    with pytest.raises(UnirenderError, match=r"^ball\.png: did not arrive"):
        Upload.take(path)


def test_a_picture_is_not_refused_for_the_memory_of_taking_it_apart_at_its_own_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = Upload("a.png", png(np.full((100, 100, 3), 0.5)))
    monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda: BYTES_OF_NONE + 60 * 100 * 100)
    assert read_upload(taken, None, LIMITS)[0].image_srgb.shape == (100, 100, 3)


def test_a_picture_comes_with_its_alpha_channel_or_with_a_mask_or_as_a_whole() -> None:
    found, remarks = read_upload(upload(), None, LIMITS)
    assert remarks == ()
    expected = ball().mask
    np.testing.assert_array_equal(found.mask, expected)
    plain = Upload("plain.png", png(ball().image_srgb))
    assert expected is not None
    masked, remarks = read_upload(plain, Upload("mask.png", png(np.repeat(expected, 3, axis=-1))), LIMITS)
    assert remarks == ()
    np.testing.assert_array_equal(masked.mask, expected)
    whole, remarks = read_upload(plain, None, LIMITS)
    assert whole.mask is not None
    assert (whole.mask == 1).all()
    assert remarks == ("No mask and no alpha channel: the whole frame is taken as the object.",)


def test_what_the_command_line_would_remark_of_a_picture_the_page_says() -> None:
    opaque = np.concatenate([ball().image_srgb, np.ones((SIZE, SIZE, 1))], axis=-1)
    _, remarks = read_upload(Upload("opaque.png", png(opaque)), None, LIMITS)
    assert remarks == ("The alpha channel covers the whole frame, which is taken as the object.",)
    rgb = np.full((8, 16, 3), 0.5, np.float32)
    rgb[2, 3, 1] = -1.0
    negative = Upload("filtered.exr", exr_bytes(image_channels(rgb), half=False))
    _, remarks = read_upload(negative, Upload("mask.png", png(np.ones((8, 16, 3)))), LIMITS)
    assert remarks == (
        "The mask covers the whole frame, which is taken as the object.",
        "0.5% of the picture's radiance is negative and was set to 0.",
    )


NAN = nan_exr()
REFUSED = {
    "broken": (Upload("a.png", upload().data[:90]), "a.png: not a readable picture"),
    "no picture": (Upload("a.png", b"hello"), "a.png: not a readable picture"),
    "empty mask": (upload("a.png", dataclasses.replace(ball(), mask=np.zeros((SIZE, SIZE, 1), np.float32))), "empty"),
    "many bytes": (Upload("a.png", bytes(2_000_000)), "a.png: 2.0 MB, expected at most 1 MB"),
    "many pixels": (Upload("a.png", png_head(20_000, 8_000)), "20000 x 8000 pixels, expected at most 1,000,000"),
    "NaN": (Upload("a.exr", NAN), "NaN or infinite"),
    "no EXR": (Upload("a.exr", b"hello"), "a.exr: not a readable OpenEXR file"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_picture_is_refused_with_a_sentence_that_names_no_folder(case: str) -> None:
    refused, expected = REFUSED[case]
    with pytest.raises(UnirenderError) as error:
        read_upload(refused, None, LIMITS)
    assert expected in str(error.value)
    assert "/" not in str(error.value)


def test_a_light_is_read_and_brought_to_a_size_and_a_bad_one_refused() -> None:
    assert read_light(Upload("a.exr", radiance(2.0, (65, 130))), LIMITS).shape == (65, 130, 3)
    large = Upload("a.exr", radiance(2.0, (300, 600)))
    assert read_light(large, LIMITS).shape == (*LIGHT_SHAPE, 3)
    for bad, expected in ((NAN, "NaN"), (radiance(0.0), "a.exr")):
        with pytest.raises(UnirenderError, match=expected):
            read_light(Upload("a.exr", bad), LIMITS)


def test_a_picture_becomes_a_square_of_a_side_that_is_known() -> None:
    assert square(ball(100), 64).image_srgb.shape == (64, 64, 3)
    with pytest.raises(UnirenderError, match="expected one of 64, 128 pixels"):
        square(ball(100), 65)


@pytest.mark.parametrize("edit", [{"roughness": 0.9}, {"metallic": 1.0}, {"roughness": 0.1, "metallic": 0.0}])
@pytest.mark.parametrize("anchored", [True, False])
def test_an_edit_is_the_pipelines(
    pipeline: UniRenderPipeline, subject: Subject, edit: dict[str, Any], anchored: bool
) -> None:
    seen = session.view(pipeline, subject, Controls(**edit, anchored=anchored))
    picture = subject.picture
    expected = pipeline.edit(
        picture.image_srgb, picture.mask, **edit, anchored=anchored, decomposition=subject.decomposition
    )
    np.testing.assert_allclose(seen.image_linear, expected.image_linear, rtol=0, atol=1e-5)
    other = pipeline.edit(picture.image_srgb, picture.mask, metallic=0.5, decomposition=subject.decomposition)
    assert np.abs(seen.image_linear - other.image_linear).max() > 1e-3, "the twin: another edit"


def test_a_light_is_the_pipelines_and_can_be_turned(pipeline: UniRenderPipeline, subject: Subject) -> None:
    light = np.random.default_rng(0).uniform(0, 2, (9, 16, 3)).astype(np.float32)
    picture = subject.picture
    for turn in (0.0, 90.0):
        seen = session.view(pipeline, subject, Controls(light=light, turn_deg=turn))
        expected = pipeline.relight(
            picture.image_srgb, session.turned(light, turn), picture.mask, decomposition=subject.decomposition
        )
        np.testing.assert_allclose(seen.image_linear, expected.image_linear, rtol=0, atol=1e-5)
    turned = session.view(pipeline, subject, Controls(turn_deg=90))
    before, after = (maps.require("environment")["environment"] for maps in (subject.maps, turned.intrinsics))
    np.testing.assert_allclose(after, session.turned(before, 90), rtol=0, atol=1e-6)
    assert "nothing casts a new shadow" in turned.remarks[0]


def test_what_came_from_the_viewer_comes_from_the_right_after_a_quarter_turn() -> None:
    light = np.zeros((17, 32, 3), np.float32)
    light[8, 15:17] = 1  # +z, the middle of the map
    at = {deg: int(session.turned(light, deg)[8, :, 0].argmax()) for deg in (0, 90, -90, 360)}
    assert at[90] in (7, 8), "azimuth pi/2: +x"
    assert at[-90] in (23, 24)
    assert at[0] == at[360] == 15


def test_untouched_controls_show_the_picture_and_a_coarse_light_is_named(
    pipeline: UniRenderPipeline, subject: Subject
) -> None:
    seen = session.view(pipeline, subject, Controls())
    np.testing.assert_array_equal(seen.image_linear, subject.image_linear)
    assert seen.remarks == ()
    sharp = session.view(pipeline, subject, Controls(roughness=0.02))
    assert "too coarse to show what roughness 0.02 reflects" in sharp.remarks[0]
    with pytest.raises(UnirenderError, match="metallic"):
        session.view(pipeline, subject, Controls(metallic=1.5))


@pytest.mark.slow
def test_mitsubas_check_scores_as_the_benchmark_does(pipeline: UniRenderPipeline, subject: Subject) -> None:
    seen = session.view(pipeline, subject, Controls(roughness=0.5))
    found = session.check(seen, spp=16)
    scores = score_image(found.model, found.mitsuba, subject.mask)
    assert found.psnr_db == pytest.approx(scores[metric_key("relit", METRICS["psnr"])], abs=1e-4)
    assert 0 < found.flip_mean < 1
    same = session.check(dataclasses.replace(seen, rendered=found.mitsuba), spp=16)
    assert (same.psnr_db, same.flip_mean) == (float("inf"), 0)
    html = panels.check_panel(found, seen.intrinsics)
    assert html.count("<img") == 3
    assert f"PSNR {found.psnr_db:.1f} dB" in html


def test_the_spread_is_of_the_samples(pipeline: UniRenderPipeline, subject: Subject) -> None:
    std = session.spread(pipeline, subject, samples=2)
    again = session.spread(pipeline, subject, samples=2)
    assert set(std) == set(panels.NAMES)
    for name, value in std.items():
        np.testing.assert_array_equal(value, again[name])
    assert max(float(value.max()) for value in std.values()) > 0
    assert panels.spread_panel(std, subject.mask, 2).count("<img") == len(std)


def test_a_material_that_is_known_is_dark_in_the_spread() -> None:
    """One number for the object: scaled by its own largest value it was white, however small."""
    mask = np.ones((8, 8, 1), np.float32)
    std = {name: np.full((8, 8, 1), 0.05, np.float32) for name in ("roughness", "albedo")}
    html = panels.spread_panel(std, mask, 5)
    shown = [base64.b64decode(part.split('"')[0]) for part in html.split("base64,")[1:]]
    assert [int(np.asarray(Image.open(io.BytesIO(data)))[4, 4, 0]) for data in shown] == [26, 255]
    assert "up to 0.05; white: 0.5" in html


def test_archives_hold_what_is_seen_and_leave_nothing_behind(
    pipeline: UniRenderPipeline, subject: Subject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    seen = session.view(pipeline, subject, Controls(roughness=0.9))
    packed = archives(seen, {"command": "demo"})
    assert not list(tmp_path.iterdir())
    members = {name: set(zipfile.ZipFile(io.BytesIO(data)).namelist()) for name, data in packed.items()}
    assert {"intrinsics.exr", "environment.exr", "image.exr", "meta.json"} <= members["maps.zip"]
    assert {"card.gltf", "base_color.png", "metallic_roughness.png", "normal.png"} <= members["gltf.zip"]
    assert {"scene.xml", "card.ply", "base_color.png", "environment.exr"} <= members["mitsuba.zip"]
    gltf = zipfile.ZipFile(io.BytesIO(packed["gltf.zip"]))
    assert {image["uri"] for image in json.loads(gltf.read("card.gltf"))["images"]} <= members["gltf.zip"]
    zipfile.ZipFile(io.BytesIO(packed["maps.zip"])).extractall(tmp_path / "maps")
    maps: Intrinsics = read_result(tmp_path / "maps")
    inside = subject.mask > 0
    np.testing.assert_allclose(maps.require("roughness")["roughness"][inside], 0.9, rtol=0, atol=1e-3)


def test_jobs_say_what_the_page_shows(pipeline: UniRenderPipeline, subject: Subject) -> None:
    context = jobs.Context(pipeline, LIMITS)
    opened = jobs.open_upload(context, Upload("plain.png", png(ball(64).image_srgb)), None, 64)
    assert "the whole frame is taken as the object" in opened.view
    assert opened.view.count("<img") == 3
    assert opened.maps.count("<img") == len(panels.NAMES)
    assert f"Roughness {opened.subject.decomposition.roughness:.2f}" in opened.maps
    assert jobs.show(context, subject, Controls()) != jobs.show(context, subject, Controls(metallic=1.0))
    assert jobs.pack(context, subject, Controls()).count("<a download") == 3
    assert jobs.open_light(context, Upload("a.exr", radiance(2.0))).shape == (64, 128, 3)


def test_names_are_text_in_html() -> None:
    html = panels.figure('<script>"', np.zeros((2, 2, 3), np.float32), note="<b>")
    assert "<script>" not in html
    assert "&lt;script&gt;&quot;" in html
    assert "&lt;b&gt;" in html


PAGE = """<head><base href="./" /><meta name="viewport" content="width=device-width" />
<meta property="og:image" content="https://example.org/a.jpg" /><link rel="stylesheet" href='https://example.org/a.css'>
<script src="https://example.org/a.js"></script><script src="./own.js"></script><a href="https://example.org">link</a>"""


def test_a_page_loses_what_it_would_fetch_from_elsewhere_and_nothing_else() -> None:
    found = server.cleaned(PAGE)
    assert not any(name in found for name in ("a.jpg", "a.css", "a.js"))
    assert '<script src="./own.js"></script><a href="https://example.org">link</a>' in found
    assert "viewport" in found


@pytest.mark.parametrize("kind", ["text/html; charset=utf-8", "application/json"])
def test_every_answer_has_the_policy_and_only_html_is_changed(kind: str) -> None:
    halves = [PAGE[:200].encode(), PAGE[200:].encode()]

    async def app(scope: Any, receive: Any, send: Any) -> None:
        headers = [(b"content-type", kind.encode()), (b"content-length", str(len(PAGE)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        for half, more in zip(halves, (True, False), strict=True):
            await send({"type": "http.response.body", "body": half, "more_body": more})

    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(server.NothingElsewhere(app)({"type": "http"}, None, send))  # pyright: ignore[reportArgumentType] - never received
    headers = dict(sent[0]["headers"])
    assert b"default-src 'self'" in headers[b"content-security-policy"]
    body = b"".join(message["body"] for message in sent[1:]).decode()
    assert body == (server.cleaned(PAGE) if kind.startswith("text/html") else PAGE)
    assert int(headers[b"content-length"]) == len(body)


@pytest.mark.parametrize("wrong", [{"port": 0}, {"port": 70_000}, {"max_pixels": 0}, {"max_megabytes": 0.0}])
def test_options_outside_their_range_are_refused(wrong: dict[str, Any]) -> None:
    Demo().check()
    with pytest.raises(UsageError, match=r"--\w"):
        Demo(**wrong).check()


def test_an_address_is_looked_at_before_the_model_is_loaded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unknown(*arguments: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    def said(*arguments: str) -> str:
        with pytest.raises(SystemExit) as stop:
            main(["demo", *arguments])
        assert stop.value.code == 1
        found = capsys.readouterr()
        assert found.out == ""  # not even that the model is being loaded
        return found.err

    monkeypatch.setattr("unirender_evaluation.demo.command.find_spec", lambda name: name)  # gradio may be missing here
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        for host in ("127.0.0.1", "0.0.0.0"):
            assert f"--port {port}: cannot be listened on (Address already in use)" in said(
                "--port", port, "--host", host
            )
    check_address("127.0.0.1", int(port))  # the twin
    assert "--host 192.0.2.1: is no address of this machine" in said(
        "--host", "192.0.2.1", "--port", port
    )  # of RFC 5737
    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    assert "--host nosuch.invalid: cannot be looked up (Name or service" in said("--host", "nosuch.invalid")


def test_without_gradio_the_command_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gradio", None)
    with pytest.raises(SystemExit) as stop:
        main(["demo"])
    assert stop.value.code == 1
    assert "pip install 'unirender[demo]'" in capsys.readouterr().err
