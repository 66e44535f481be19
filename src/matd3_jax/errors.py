"""The one exception for what a user can put right."""


class UserError(ValueError):
    """A setting, file or directory that will not do; its message is one line that says why and what would."""
