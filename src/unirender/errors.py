"""The exceptions that a user of unirender is meant to read."""


class UnirenderError(ValueError):
    """Bad input or an unusable environment.

    The message says what was wrong, what was got, what was expected and what to do about it; the command line prints
    it as one line and exits with status 1.
    """


class UsageError(UnirenderError):
    """A command line that no file or machine could make right: an option outside its values, options that contradict
    each other, nothing to do. The command line exits with status 2.
    """
