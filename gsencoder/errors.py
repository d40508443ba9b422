"""The one exception that means "the input is wrong", as opposed to "the program is wrong".

Every message is one line that says what was wrong, where, what was expected, and what to do. The command line
prints it and leaves with exit code 2; anything else that escapes is a defect of ours and keeps its traceback.
"""


class InputError(ValueError):
    """A file, option or array given by the user cannot be used; the message says why and what to do."""


class SceneWarning(UserWarning):
    """Something in the input was left out or estimated; the message counts it and says how."""
