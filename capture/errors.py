"""The one exception that capture raises for a mistake in a recording or a calibration."""


class RecordingError(ValueError):
    """What is wrong with the user's files, in one or two lines: what was found, where, and what to do.

    The command line prints the text without a traceback.
    """
