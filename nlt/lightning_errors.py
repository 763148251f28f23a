"""The messages of jsonargparse and Lightning, in one line and in the words of `nlt.config`."""

import re


def one_line(message: str) -> str:
    """Return a message of jsonargparse or Lightning in one line, without the alternatives that were not meant."""
    message = " ".join(message.split())
    message = re.sub(r"Group '([\w.]+)' does not accept option '(\w+)'", r"Option '\1.\2' is not accepted", message)
    message = re.sub(r"Does not validate .*? Errors: - (.*?) - Expected a <class 'NoneType'>.*", r"\1", message)
    message = re.sub(
        r"""Parser key "model": Problem with given class_path '(?:\w+\.)*(\w+)': (?=Parser|Option)""", r"\1: ", message
    )
    return re.sub(r'Parser key "([\w.]+)": Expected an? (.+?)\. Got value: ', _must_be, message)


_KINDS = {"<class 'int'>": "a whole number", "<class 'float'>": "a number", "<class 'bool'>": "true or false"}


def _must_be(found: re.Match[str]) -> str:
    """Return jsonargparse's "Parser key K: Expected a KIND. Got value: " in the words of `nlt.config`."""
    key, kind = found.groups()
    options = re.fullmatch(r"typing\.Literal\[(.*)\]", kind)
    expected = f"one of {options[1].replace(chr(39), '')}" if options else _KINDS.get(kind, kind)
    return f"{key}: must be {expected}, is "


def with_source(message: str, sources: dict[str, str], command: str) -> str:
    """Return jsonargparse's message in one line that begins with the files or arguments that it is about."""
    message = one_line(message)
    keys = re.findall(r"""[Oo]ption ['"]([\w.]+)['"]|Parser key ['"]([\w.]+)['"]|([\w.]+): must be""", message)
    words = "".join(keys[-1]).split(".") if keys else []
    matching = [name for name, text in sources.items() if all(re.search(rf"\b{word}\b", text) for word in words)]
    # Settings override configs.
    place = " + ".join([name for name in matching if "=" in name] or matching or sources) or f"nlt {command}"
    return f"{place}: {message}; see nlt {command} --help"
