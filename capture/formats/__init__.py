"""Other people's calibration formats, one file each: the only place that knows their conventions."""
