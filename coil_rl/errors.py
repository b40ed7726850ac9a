"""The one exception that programs turn into a sentence."""


class UserError(Exception):
    """Something a person gave is wrong; the message says what, what was expected and what to do."""
