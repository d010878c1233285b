"""The loop's end of the way from the page: what may come, and how much of it in a turn. No clock; waits for nobody."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from fes.live.inputs import Carry
from fes.live.orders import Ask, Order, OrderRefused, order_of_message
from fes.live.states import State
from fes.page.feed import PageFeed
from fes.signals import Event

RESUME: Final = b'{"ask":"resume","confirm":true}'
ALLOWED: Final = frozenset((Ask.STOP, Ask.ARM, Ask.DISARM, Ask.PAUSE, Ask.UP, Ask.DOWN))
AT_ONCE: Final = 8
LONGEST: Final = 256
ORIGIN: Final = "page"


class PageOrders:
    """An input of the live session (see ``fes.live.ports.Input``).

    The page's process is not trusted: of all orders only those in ALLOWED exist here, what leads to more current needs
    its confirmation again, *pause* never goes on, and however much comes, a turn carries out one stop, before anything
    else, or a few others.

    Args:
        feed: its other direction.
        carry: carries an order out.
        state: where the session stands.
        confused: told of a message that is no order.
    """

    def __init__(
        self,
        feed: PageFeed,
        carry: Carry,
        state: Callable[[], State],
        confused: Callable[[int, str], None] = lambda t_ns, text: None,
    ) -> None:
        self._feed = feed
        self._carry = carry
        self._state = state
        self._confused = confused

    def fileno(self) -> int | None:
        """While the page's process is there."""
        return None if self._feed.lost else self._feed.link.fileno()

    def take(self, t_ns: int) -> list[Event]:
        """Carry out what has come; a stop among it comes first and puts the rest aside."""
        orders: list[Order] = []
        for message in self.messages():
            try:
                if (order := self._order(message)) is not None:
                    orders.append(order)
            except OrderRefused as error:
                self._confused(t_ns, f"the page sent what is no order: {error}")
        stop = next((order for order in orders if order.ask is Ask.STOP), None)
        return [event for order in ([stop] if stop else orders) for event in self._carry(order, t_ns)]

    def messages(self) -> list[bytes]:
        """What has come, at most a few."""
        found: list[bytes] = []
        while len(found) < AT_ONCE and not self._feed.lost:
            try:
                message = self._feed.link.recv(LONGEST)
            except BlockingIOError:
                break
            except OSError as error:
                message = b""
                self._feed.lose(error.strerror or str(error))
            if not message:
                self._feed.lose("its process has ended")
                break
            found.append(message)
        return found

    def _order(self, message: bytes) -> Order | None:
        """The order; None where it means nothing as the session stands.

        Raises:
            OrderRefused: it is none that a page may give.
        """
        if message == RESUME:
            return Order(Ask.PAUSE, origin=ORIGIN) if self._state() is State.PAUSED else None
        order = order_of_message(message)
        if order.ask not in ALLOWED:
            raise OrderRefused(f"{order.ask} is not the page's business")
        if order.ask is Ask.PAUSE and self._state() is State.PAUSED:
            return None  # pressed on two pages at once: the second must not go on
        return Order(order.ask, origin=ORIGIN)
