"""The one exception that a user of unirender is meant to read."""


class UnirenderError(ValueError):
    """Bad input or an unusable environment.

    The message says what was wrong, what was got, what was expected and what to do about it; the command line prints
    it as one line and exits with status 1.
    """
