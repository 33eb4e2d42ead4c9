"""Everything that can go wrong with what a user hands in.

CanopyError
├── UsageError        an argument is wrong: the caller can mend the call
├── RecordingError    a recording cannot be read, or holds nothing usable
├── ViewError         one view is unusable; the others go on
└── DocumentError     a skeleton document does not follow its schema
"""


class CanopyError(Exception):
    """Base of all errors that are the input's fault; the message names the thing and the mend."""


class UsageError(CanopyError):
    """An argument is outside its range or names something unknown."""


class RecordingError(CanopyError):
    """A recording cannot be read, or holds nothing usable."""


class ViewError(CanopyError):
    """One view of a scan is unusable; the others are not affected."""


class DocumentError(CanopyError):
    """A skeleton document does not follow its schema."""
