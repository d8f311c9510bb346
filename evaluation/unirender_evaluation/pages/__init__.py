"""The tables of the project's own pages, made from the results of a checkout; no part of the wheel."""
