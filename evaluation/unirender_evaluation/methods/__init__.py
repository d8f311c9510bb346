"""Methods, which are what a benchmark's rows are made of: ours, the trivial ones, Mitsuba's, and strangers'."""
