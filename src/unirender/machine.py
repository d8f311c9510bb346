"""What the machine has."""

import os

GIB = 2**30


def memory_bytes() -> float:
    """Of the machine; infinite where the system does not tell."""
    pages = os.sysconf("SC_PHYS_PAGES") if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}) else -1
    return float(pages * os.sysconf("SC_PAGE_SIZE")) if pages > 0 else float("inf")


def in_gib(count: float) -> str:
    """A number of bytes for messages, rounded."""
    return f"{count / GIB:,.0f} GiB"
