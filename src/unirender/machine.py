"""What the machine has."""

import os

GIB = 2**30


def memory_bytes() -> float:
    """Of the machine; infinite where the system does not tell."""
    if "SC_PHYS_PAGES" not in getattr(os, "sysconf_names", {}):
        return float("inf")
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def in_gib(count: float) -> str:
    """A number of bytes for messages, rounded."""
    return f"{count / GIB:,.0f} GiB"
