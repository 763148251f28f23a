"""Errors caused by the user: the command line prints one line and exits with code 2."""


class UserError(Exception):
    """Invalid input. The message names the file, the field and the remedy in one line."""


class DivergedError(UserError):
    """The loss of a training run or the prediction of a method is not finite."""


def to_user_error(error: OSError) -> UserError:
    """Convert an operating-system error, for example a full disk, to a user error in one line."""
    return UserError(f"{error.filename or 'nlt'}: {error.strerror or error}; fix this and run the command again")
