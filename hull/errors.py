"""The exceptions of this room."""


class HullError(ValueError):
    """No hull can be made of what was given: one or two sentences that say why and what to do."""


class EmptyHullError(HullError):
    """Nothing is left of the person; the text names the cameras at fault."""


class ScanError(HullError):
    """A folder or file of scans cannot be used: which, and why."""
