"""What an operator can order of the tuning: freeze, go on, accept a suggestion, roll back. Pure: no clock, no I/O.

An accepted suggestion and a roll-back change the next burst, so a key must be pressed twice: the first time says what
would change, the second one within five seconds does it, unless something else is suggested by then. Over the control
socket the message's confirmation stands for the second key.
"""

from __future__ import annotations

from typing import Final

from fes.controller import Controller
from fes.live.orders import Ask, Order
from fes.signals import NS_PER_S, OperatorAct, OperatorAction
from fes.stimulation.parameters import BurstParameters
from fes.stimulation.tuning.reports import difference
from fes.stimulation.tuning.tuner import Tuner

AGAIN_NS: Final = 5 * NS_PER_S
ACTIONS: Final = {
    Ask.FREEZE_TUNING: OperatorAction.FREEZE_TUNING,
    Ask.RESUME_TUNING: OperatorAction.RESUME_TUNING,
    Ask.ACCEPT_SUGGESTION: OperatorAction.ACCEPT_SUGGESTION,
    Ask.ROLL_BACK: OperatorAction.ROLL_BACK,
}
_KEY_OF: Final = {Ask.ACCEPT_SUGGESTION: "y", Ask.ROLL_BACK: "r"}


class Refusal(ValueError):
    """The order cannot be carried out now; the text says why."""


class TuningOrders:
    """Of one session; ``message`` says what came of the last order."""

    def __init__(self, controller: Controller) -> None:
        self._tuning = controller.tuning
        self._asked: tuple[Ask, int, BurstParameters] | None = None  # pressed once: what would come of it
        self._asked_ns = 0
        self.message = ""

    def take(self, order: Order, channel: int, t_ns: int) -> list[OperatorAct]:
        """The events that carry the order out; none where a key must be pressed again.

        Args:
            order: one of :data:`ACTIONS`.
            channel: the selected one; for a suggestion and a roll-back.
            t_ns: now.

        Raises:
            Refusal: nothing tunes itself, nothing is suggested, or it is so already.
        """
        tuners = self._tuning.tuners
        if not tuners:
            raise Refusal('no channel of this session tunes itself (tuning.mode is "off")')
        if order.ask is Ask.FREEZE_TUNING:
            if all(tuner.frozen for tuner in tuners.values()):
                raise Refusal("tuning is frozen already")
            return self._act(order, t_ns, 0, "tuning frozen; the settings stay as they are")
        if order.ask is Ask.RESUME_TUNING:
            if not any(tuner.frozen for tuner in tuners.values()):
                raise Refusal("tuning is not frozen")
            return self._act(order, t_ns, 0, "tuning goes on")
        tuner = tuners.get(channel)
        if tuner is None:
            raise Refusal(f"channel {channel} does not tune itself")
        return self._change(order, channel, t_ns, tuner)

    def _change(self, order: Order, channel: int, t_ns: int, tuner: Tuner) -> list[OperatorAct]:
        after = tuner.pending if order.ask is Ask.ACCEPT_SUGGESTION else tuner.start
        if order.ask is Ask.ACCEPT_SUGGESTION and tuner.frozen:
            raise Refusal(f"tuning is frozen ({tuner.frozen}); nothing is accepted")
        if after is None:
            raise Refusal(f"nothing is suggested for channel {channel}")
        said = difference(tuner.parameters, after) or "nothing changes"
        what = "accept" if order.ask is Ask.ACCEPT_SUGGESTION else "roll back and freeze"
        asked, now = self._asked, (order.ask, channel, after)
        if order.origin == "key" and (asked != now or t_ns - self._asked_ns > AGAIN_NS):
            self._asked, self._asked_ns = now, t_ns
            self.message = f"channel {channel}, {what}: {said}? {_KEY_OF[order.ask]} again"
            return []
        return self._act(order, t_ns, channel, f"channel {channel}, {what}: {said}, from the next burst on")

    def _act(self, order: Order, t_ns: int, channel: int, message: str) -> list[OperatorAct]:
        self._asked = None
        self.message = message
        return [OperatorAct(t_ns, ACTIONS[order.ask], float(channel))]
