"""Whether the page can be served where it is asked for: looked at before a model is loaded."""

import errno
import os
import socket

from unirender.errors import UnirenderError

LOCALHOST = "127.0.0.1"  # where gradio looks for its own page
OF_THE_HOST = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT)


def check_address(host: str, port: int) -> None:
    """Binds the address, and lets go of it.

    Raises:
        UnirenderError: the name means nothing, the address is none of this machine's, or the port is taken or not
            allowed.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UnirenderError(
            f"demo: --host {host}: cannot be looked up ({reason}), expected an address or a name of this machine"
        ) from error
    addresses = dict.fromkeys((family, address) for family, _, _, _, address in found)
    reasons = [_reason(family, address) for family, address in (*addresses, (socket.AF_INET, (LOCALHOST, port)))]
    if all(reason in OF_THE_HOST for reason in reasons[:-1]):
        raise UnirenderError(f"demo: --host {host}: is no address of this machine, expected one (127.0.0.1, 0.0.0.0)")
    for reason in reasons:
        if reason is not None and reason not in OF_THE_HOST:
            raise UnirenderError(
                f"demo: --port {port}: cannot be listened on ({os.strerror(reason)}), expected a free port of this "
                "machine; choose another --port"
            )


def _reason(family: int, address: tuple) -> int | None:
    """The system's number for why an address cannot be bound; None: it can."""
    try:
        with socket.socket(family, socket.SOCK_STREAM) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what was left in TIME_WAIT is no listener
            if family == socket.AF_INET6:
                tried.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            tried.bind(address)
    except OSError as error:
        return error.errno
    return None
