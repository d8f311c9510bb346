"""Serves the page, and sees to it that it asks no other host: no analytics, no fonts or scripts from elsewhere.

gradio's own page names other hosts in its head. What would be fetched from there is taken out, and the browser is told
by a Content-Security-Policy not to fetch anything from elsewhere, whatever else asks for it.
"""

import os
import re
import tempfile
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from importlib import resources
from typing import Any

from unirender.errors import UnirenderError
from unirender.pictures import Picture
from unirender_evaluation.demo.uploads import Limits
from unirender_evaluation.demo.worker import Worker
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.tasks import picture

# Read by gradio when it is imported, and by what it imports.
QUIET = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_OFFLINE": "1"}
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob:; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'self'; form-action 'self'; frame-ancestors 'self'"
)
HEADERS = {"content-security-policy": POLICY, "referrer-policy": "no-referrer", "x-content-type-options": "nosniff"}
ELSEWHERE = re.compile(
    r"<(?:script|link|meta)\b[^>]*\b(?:src|href|content)=[\"']https?://[^>]*>(?:\s*</script>)?", re.S
)
# gradio's list opens at any key but Enter and Escape, Tab too, and so stayed open behind whoever tabbed past it.
TAB_PASSES = """() => document.addEventListener("keydown", event => {
  if (event.key == "Tab" && event.target.role == "combobox") event.stopPropagation() }, true)"""
VISITORS = 64  # that are remembered at a time; whoever comes later takes the place of the oldest
Message = MutableMapping[str, Any]  # of ASGI
EXAMPLES = {"gear": "test-000020_l1", "knot": "test-000012_l0", "ball": "test-000019_l0", "rock": "test-000004_l0"}


def serve(worker: Worker, limits: Limits, host: str, port: int) -> None:
    """Serves the page until it is interrupted."""
    with served(worker, limits, host, port) as address:
        print(f"unirender demo: {address} (Ctrl-C ends it)", flush=True)
        threading.Event().wait()


@contextmanager
def served(worker: Worker, limits: Limits, host: str, port: int) -> Iterator[str]:
    """The page's address while the block runs; what visitors uploaded is deleted when it ends."""
    with tempfile.TemporaryDirectory(prefix="unirender-demo-") as folder:
        os.environ.update(QUIET | {"GRADIO_TEMP_DIR": folder})
        from gradio.themes import Default
        from starlette.middleware import Middleware

        from unirender_evaluation.demo.page import Page, example_styles

        examples = example_pictures()
        page = Page(worker, limits, examples).build()
        styles = (resources.files("unirender_evaluation") / "templates" / "demo.css").read_text(encoding="utf-8")
        try:
            _, address, _ = page.launch(
                server_name=host,
                server_port=port,
                prevent_thread_lock=True,
                quiet=True,
                share=False,
                ssr_mode=False,
                run_history=False,
                footer_links=[],
                state_session_capacity=VISITORS,
                max_file_size=int(limits.megabytes * 1e6),
                theme=Default(
                    primary_hue="teal", font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"]
                ),
                css=styles + example_styles(examples),
                js=TAB_PASSES,
                app_kwargs={"middleware": [Middleware(NothingElsewhere)]},
            )
        except OSError as error:
            raise UnirenderError(
                f"demo: cannot listen on {host}:{port} ({error}); choose another --port, or --host"
            ) from error
        try:
            yield address
        finally:
            page.close(verbose=False)


def example_pictures() -> Mapping[str, Picture]:
    """Pictures of the tiny suite, as methods see them."""
    suite = load_suite("tiny")
    found = {}
    for name, key in EXAMPLES.items():
        seen = picture(suite, suite.scene(key), suite.spec.base)
        found[name] = Picture(seen["image_srgb"], seen["mask"], f"{name}.png")
    return found


def cleaned(page: str) -> str:
    """A page of HTML without elements that name another host."""
    return ELSEWHERE.sub("", page)


class NothingElsewhere:
    """ASGI middleware: `HEADERS` on every answer, and HTML without elements that name another host."""

    def __init__(self, app: Callable[..., Awaitable[None]]) -> None:
        self.app = app

    async def __call__(
        self, scope: Message, receive: Callable[[], Awaitable[Message]], send: Callable[[Message], Awaitable[None]]
    ) -> None:
        """Answers one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        held: list[Message] = []  # the head of an answer in HTML, until its body is known

        async def pass_on(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [*message["headers"], *((k.encode(), v.encode()) for k, v in HEADERS.items())]
                message = {**message, "headers": headers}
                if any(key == b"content-type" and value.startswith(b"text/html") for key, value in headers):
                    held.append(message)
                    return
            elif held:
                held.append(message)
                if message.get("more_body"):
                    return
                start, *parts = held
                body = cleaned(b"".join(part.get("body", b"") for part in parts).decode()).encode()
                start["headers"] = [(key, value) for key, value in start["headers"] if key != b"content-length"]
                start["headers"].append((b"content-length", str(len(body)).encode()))
                held.clear()
                await send(start)
                message = {"type": "http.response.body", "body": body}
            await send(message)

        await self.app(scope, receive, pass_on)
