"""The one exception for a user's mistake: the command line prints it as one line and exits with 2."""


class UserError(Exception):
    """Bad input. The message names the file, the field and the remedy, in one line."""


class DivergedError(UserError):
    """A training whose loss, or a method whose prediction, is not finite."""


def to_user_error(error: OSError) -> UserError:
    """No space, no permission and the like: what is written stays."""
    return UserError(f"{error.filename or 'nlt'}: {error.strerror or error}; set it right and run again")
