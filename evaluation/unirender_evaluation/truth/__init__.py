"""The truth of a suite: how it is made and tested."""
