"""The one loop, live and replay: sources, controller, runner, the clocks' agreement, a replay's identity."""
