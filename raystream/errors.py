"""The errors of raystream that are not plain ValueError, TypeError or OSError."""


class DeviceError(RuntimeError):
    """No OpenCL device can be used, or the chosen one cannot compile and run kernels."""


class BuildError(RuntimeError):
    """An OpenCL program failed to build; the message holds the file, the options and the log."""


class MemoryLimitError(MemoryError):
    """The stated `memory_limit` or the device's memory is too small for the work."""
