"""Press the page's stop from a program: one request, no token. For fault campaigns and tests."""

from __future__ import annotations

import http.client
from typing import Final

from fes.page.address import LOOPBACK

WITHIN_S: Final = 2.0


def press_stop(port: int) -> None:
    """Ask the page on this port for an emergency stop; returns when its process has handed that on.

    Raises:
        OSError: nobody serves there, or it refuses.
    """
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=WITHIN_S)
    try:
        connection.request("POST", "/stop", headers={"Origin": f"http://{LOOPBACK}:{port}"})
        answer = connection.getresponse()
        if answer.status != http.client.OK:
            raise OSError(f"the page answered {answer.status} {answer.read(200).decode(errors='replace')}")
    except http.client.HTTPException as error:
        raise OSError(f"the page does not answer: {error}") from error
    finally:
        connection.close()
