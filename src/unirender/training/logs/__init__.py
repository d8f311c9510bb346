"""Logs: what a run says while it trains, in the terminal, in its folder and to trackers."""
