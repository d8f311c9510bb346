"""What the machine is too small for, said before a measurement begins."""

from unirender.errors import UnirenderError
from unirender.system.machine import memory_excess


def check_size(resolution: int) -> None:
    """Looks at the size of square renders; raises UnirenderError where the machine has not the memory for one."""
    from unirender_reference.render import BYTES_A_PIXEL

    if excess := memory_excess(BYTES_A_PIXEL * resolution**2):
        raise UnirenderError(f"--resolution {resolution}: {excess}; render fewer pixels")
