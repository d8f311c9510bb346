"""What a run does by the clock."""

import time


class Due:
    """Says when something is due again. The minutes of each begin now, and again when it was due; None: never."""

    def __init__(self, **minutes: float | None) -> None:
        self.minutes = minutes
        self.since = dict.fromkeys(minutes, time.monotonic())

    def __call__(self, name: str) -> bool:
        minutes, now = self.minutes[name], time.monotonic()
        if minutes is None or now - self.since[name] < 60 * minutes:
            return False
        self.since[name] = now
        return True
