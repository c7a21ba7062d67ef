"""Command lines from option classes: their fields are read by cyclopts, and told in help.

A command is a class of options whose ``run`` does the work and whose docstring says what that is.
An option that several classes in it have is given once, and reaches all of them.
"""

from __future__ import annotations

import ast
import errno
import inspect
import math
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence, Set
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_origin

from usdbrdf import options
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsageError
from usdbrdf.job.interrupts import loading
from usdbrdf.option import REQUIRED, Option, OptionField, Options, option_fields
from usdbrdf.options import Insert

EXIT_CODES = """exit codes:
  0 done   1 a defect of usdbrdf   2 wrong options   3 input refused (do not retry)
  4 disk, memory, permission or a missing package (retry may help)   5 asset folder busy
  6 asset folder is not ours, or files of ours were edited by hand
  7 validate found errors, or a step warned and --strict was given
  130 interrupted   143 terminated"""
_INSERT_KEYS = {item.option.name: item for item in option_fields(Insert) if item.option}
# In a folder of fpath the script is a function of its file's name; sourced it says whose it is.
_ZSH_SOURCED = """
if [[ ${funcstack[1]} == _usdbrdf ]]; then
  _cyclopts_usdbrdf "$@"
else
  compdef _cyclopts_usdbrdf usdbrdf
fi
"""


class Command(Options):
    """What a command takes; its subclasses are dataclasses too."""

    def run(self) -> int:
        """Do it; returns the exit code."""
        raise NotImplementedError


Commands = Mapping[str, type[Command]]


def parsed(arguments: Sequence[str], commands: Commands) -> Command:
    """The command that is asked for, its options checked. Raises UsageError, and InputRefused for
    files that are not there."""
    name, words = (arguments[0], list(arguments[1:])) if arguments else ("nothing", [])
    if name not in commands:
        raise UsageError(f"{name}: expected a command. See usdbrdf --help. [usage.command]")
    said, given = _said(commands[name]), {}
    valued = [x.option for x in said if x.field.kind is not bool and not x.option.placed]
    words = _without_empty(words, {name for o in valued if o.empty for name in o.names})
    _refuse_empty(words, {name for option in valued for name in option.names})
    # Nothing that was or must be said needs a parser, which takes time to load.
    if words or any(item.field.default is REQUIRED for item in said):
        with loading():
            from cyclopts import App, CycloptsError
        app = App(name=f"usdbrdf {name}", help_flags=(), version_flags=())

        app.default(_signed(said, _argument))
        try:
            given = app.parse_args(words, exit_on_error=False, print_error=False)[1].arguments
        except CycloptsError as error:
            found = " ".join(str(error).split()).rstrip(".")
            sentence = found if found.endswith("?") else f"{found}."
            raise UsageError(f"{sentence} See usdbrdf {name} --help. [usage.option]") from error
    command: Command = _made(commands[name], given)
    return command


def _without_empty(words: Sequence[str], optional: Set[str]) -> list[str]:
    """The words without those ``optional`` options whose value is empty."""
    left: list[str] = []
    for word in words:
        if not word and left and left[-1] in optional:
            left.pop()
        elif not (word.endswith("=") and word[:-1] in optional):
            left.append(word)
    return left


def _refuse_empty(words: Sequence[str], with_value: Set[str]) -> None:
    """UsageError for a word that says nothing, such as a variable of a shell that is not set, which
    cyclopts takes for the default, and Python, as a path, for the current folder.

    with_value  options that the word after them belongs to
    """
    for before, word in pairwise(["", *words]):
        option, equals, value = word.partition("=") if word.startswith("-") else ("", "", word)
        if not value and (equals or not option):
            subject = option or (before if before in with_value else "") or "''"
            raise UsageError(
                f"{subject}: the word given here is empty. Give a value, or leave it out. "
                "[usage.option]"
            )


def completion(shell: str, commands: Commands) -> str:
    """A script that lets a shell ("bash", "zsh", "fish") complete command lines."""
    from cyclopts import App

    app = App(name="usdbrdf", help_flags=("--help", "-h"), version_flags=("--version",))
    for name, owner in commands.items():
        signed = _signed(_said(owner), _completed)
        signed.__doc__ = owner.__doc__
        app.command(signed, name=name)
    script = str(app.generate_completion(shell=shell))  # type: ignore[arg-type]
    if shell == "zsh":
        return script + _ZSH_SOURCED
    # Bash itself quotes names of files and tells folders from them.
    script = script.replace('COMPREPLY=( $(compgen -f -- "${cur}") )', "COMPREPLY=()")
    return script.replace("complete -F ", "complete -o bashdefault -o default -F ")


def _signed(said: Sequence[_Said], argument: Callable[[_Said], inspect.Parameter]) -> Any:
    """A function that does nothing, with the signature that these options make."""

    def bound() -> None: ...

    signed: Any = bound
    signed.__signature__ = inspect.Signature([argument(item) for item in said])
    return signed


class _Said(NamedTuple):
    """An option, the field that it becomes, that field's class, and the title in help."""

    option: Option
    field: OptionField
    owner: type[Options]
    title: str


def _said(owner: type[Options], title: str = "") -> list[_Said]:
    """All that can be said to a command, each once, what has no name first."""
    found: dict[str, _Said] = {}
    for field in option_fields(owner):
        if field.option is None:
            for said in _said(field.kind, title or field.name.removeprefix("options")):
                found.setdefault(said.option.name, said)
        else:
            own = _Said(field.option, field, owner, field.option.shared or title)
            found.setdefault(own.option.name, own)
    return sorted(found.values(), key=lambda said: not said.option.placed)


def _key(option: Option) -> str:
    return option.name.strip("-").replace("-", "_").lower()


def _made(owner: type[Any], given: Mapping[str, Any]) -> Any:
    """An object of an option class and of those in it; what is not given is its default."""
    known = {}
    for field in option_fields(owner):
        if field.option is None:
            known[field.name] = _made(field.kind, given)
        elif (key := _key(field.option)) in given:
            # A flag says the opposite of the default.
            flag = field.kind is bool
            known[field.name] = given[key] is not field.default if flag else given[key]
            if field.option.joined:
                known[field.name] = ",".join(given[key])
    return owner(**known)


def _argument(said: _Said) -> inspect.Parameter:
    from cyclopts import Parameter

    option, field = said.option, said.field
    kind = field.kind | str if option.url else field.kind
    several = get_origin(kind) is tuple or option.joined

    def read(_kind: Any, tokens: Any) -> Any:
        return _value(field, option, [(token.index, token.value) for token in tokens])

    parameter = Parameter(
        name=option.names,
        converter=None if kind is bool or field.choices else read,
        negative=(),
        allow_repeating=True,
        json_list=False,
        # A direction such as -Y is no option.
        allow_leading_hyphen=any(choice.startswith("-") for choice in field.choices),
        consume_multiple=(1, None) if kind == tuple[Insert, ...] else None,
    )
    default = inspect.Parameter.empty if field.default is REQUIRED else None
    # As wide as what ``read`` makes, and the default: where pydantic is loaded, cyclopts has it
    # check the values against these.
    wide = (list[Any] if several else kind) | None
    return _parameter(option, default, Annotated[wide, parameter])


def _completed(said: _Said) -> inspect.Parameter:
    """The same for shells, which ask only what kind of word follows, if any does."""
    from cyclopts import Parameter

    option, kind = said.option, said.field.kind
    if get_origin(kind) is tuple or option.joined:
        kind = list[Path] if kind == tuple[Path, ...] else list[str]
    flag = kind is bool
    default = inspect.Parameter.empty if option.placed else False if flag else None
    kind = kind if option.placed or flag else kind | None
    return _parameter(option, default, Annotated[kind, Parameter(name=option.names, negative=())])


def _parameter(option: Option, default: Any, annotation: Any) -> inspect.Parameter:
    placed = inspect.Parameter.POSITIONAL_ONLY if option.placed else inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(_key(option), placed, default=default, annotation=annotation)


def _value(field: OptionField, option: Option, words: list[tuple[int, str]]) -> Any:
    """What the words after an option mean, each with its number after that occurrence of it."""
    if field.kind == tuple[Path, ...]:
        return tuple(_path(word) for _, word in words)
    if field.kind == tuple[Insert, ...]:
        texts = [word for _, word in words]
        bounds = [*(i for i, (number, _) in enumerate(words) if number == 0), len(words)]
        return tuple(_insert(*texts[first:end]) for first, end in pairwise(bounds))
    if option.joined:
        return [word for _, word in words]
    text = words[-1][1]
    if text == option.none:
        return None
    if text in option.words or (option.url and "://" in text):
        return text
    if option.file:
        # Said before any work is done; an input that is not there is refused as a capture would be.
        if not (path := _path(text)).is_file():
            raise InputRefused(f"{text}: no such file. Check the path. [usage.file]")
        return path
    return _checked(field, text, f"{option.name} {text}")


def _checked(field: OptionField, text: str, subject: str) -> Any:
    value: Any = text
    counts = field.option.counts if field.option else ()
    try:
        if field.kind in (int, float):
            value = field.kind(text)
        elif counts:
            value = tuple(float(word) for word in text.split(","))
    except ValueError:
        value = () if counts else math.nan  # which are refused
    field.check(value, subject)
    return _path(text) if field.kind is Path else value


def _path(text: str) -> Path:
    """A path that can be asked for; whether anything is there is for the command to say."""
    place = os.path.realpath(text)
    # What Python makes of a name depends on the locale; USD takes it for UTF-8.
    if os.fsencode(place) != place.encode(errors="surrogatepass"):
        raise UsageError(
            f"{text}: the name of this file, or of a folder above it, is not UTF-8, as USD asks of "
            "all names. Rename it, or set LC_ALL=C.UTF-8 if it is. [usage.path]"
        )
    try:
        os.stat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise UsageError(f"{text}: {error.strerror}. Shorten it. [usage.path]") from error
        if error.errno == errno.ELOOP:
            raise InputRefused(f"{text}: {error.strerror}. Mend the link. [usage.path]") from error
        raise EnvironmentFailure(
            f"{text}: {error.strerror}. Check the path, and the permissions of the folders above. "
            "[environment.path]"
        ) from error
    return Path(text)


def _insert(model: str, *settings: str) -> Insert:
    """MODEL KEY=VALUE ..., as typed."""
    known: dict[str, Any] = {"model": _path(model)}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or key not in _INSERT_KEYS:
            keys = ", ".join(f"{key}=" for key in _INSERT_KEYS)
            raise UsageError(f"--insert {model}: {setting!r} is none of {keys}. [relight.insert]")
        field = _INSERT_KEYS[key]
        subject = f"--insert {model}: {setting}"
        known[field.name] = _matrix(text) if key == "matrix" else _checked(field, text, subject)
    return Insert(**known)


def _matrix(text: str) -> Any:
    """(4, 4) float64, world from model."""
    import numpy as np

    from usdbrdf.files.tables import number_rows

    path = _path(text)
    if not path.is_file():
        raise InputRefused(f"{path}: no such file. Check the path. [usage.file]")
    try:
        matrix = np.array(number_rows(path)).reshape(4, 4)
    except (ValueError, InputRefused) as error:
        raise InputRefused(
            f"{path}: expected 4 rows of 4 numbers, world from model. Correct it. [relight.matrix]"
        ) from error
    singular = abs(np.linalg.det(matrix[:3, :3])) < 1e-12
    if not np.isfinite(matrix).all() or singular or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputRefused(
            f"{path}: no invertible affine matrix; its last row must be 0 0 0 1. Correct it. "
            "[relight.matrix]"
        )
    return matrix


def help_text(arguments: Sequence[str], commands: Commands) -> str | None:
    """The page that is asked for with --help or -h, of the program or of one of its commands, or
    None."""
    options_end = arguments.index("--") if "--" in arguments else len(arguments)
    if not {"-h", "--help"} & set(arguments[:options_end]):
        return None
    title, entries = "commands", [(name, _about(owner)) for name, owner in commands.items()]
    tables = {title: entries, "options": [("--version", "print the version")]}
    usage, about = "COMMAND", "captured rooms and objects into USD assets with measured materials"
    if (usage_of := arguments[0]) in commands:
        owner, tables = commands[usage_of], {"options": []}
        about = _about(owner)
        needed = [said.option for said in _said(owner) if said.field.default is REQUIRED]
        usage = " ".join((usage_of, *(f"{o.names[0]} {o.unit}".strip() for o in needed)))
        for said in _said(owner):
            tables.setdefault(said.title or "options", []).append(_entry(said))
    tables["options"].append(("-h, --help", "print this"))
    text = f"usage: usdbrdf {usage} [options]\n\n{about[0].upper()}{about[1:]}.\n\n"
    return text + "".join(map(_table, tables, tables.values())) + EXIT_CODES


def _about(owner: type[Command]) -> str:
    text = (owner.__doc__ or "").strip().rstrip(".")
    return text[0].lower() + text[1:]


def _entry(said: _Said) -> tuple[str, str]:
    option, field, owner, _ = said
    unit = "{" + ",".join(field.choices) + "}" if field.choices else option.unit
    text = option.help or _meaning(owner, field.name)
    if field.kind == tuple[Insert, ...]:
        keys = [(f"{k}={i.option.unit}", i.name) for k, i in _INSERT_KEYS.items() if i.option]
        text += " " + "; ".join(f"{key}: {_meaning(Insert, name)}" for key, name in keys)
    default = option.unset
    if not default and not isinstance(field.default, bool):
        default = "" if field.default in (REQUIRED, None, ()) else str(field.default)
    text += f" (default: {default})" if default else ""
    return f"{', '.join(option.names)} {unit}".rstrip(), text


def _meaning(owner: type[Options], name: str) -> str:
    """Of a field: what the string below it says."""
    # Options is the last of them, whose source knows none: every field is told before.
    return next(
        meanings[place]
        for base in owner.__mro__
        if (place := f"{base.__name__}.{name}") in (meanings := _meanings(base.__module__))
    )


@cache
def _meanings(module: str) -> dict[str, str]:
    return {
        f"{owner.name}.{ast.unparse(field.target)}": " ".join(
            str(ast.literal_eval(below.value)).format_map(vars(options)).split()
        )
        for owner in ast.parse(inspect.getsource(sys.modules[module])).body
        if isinstance(owner, ast.ClassDef)
        for field, below in pairwise(owner.body)
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr)
    }


def _table(title: str, entries: Sequence[tuple[str, str]]) -> str:
    column, width = 24, max(min(shutil.get_terminal_size().columns, 100), 48)
    lines = [f"{title}:"]
    for names, text in entries:
        start = f"  {names}  ".ljust(column)
        if len(start) > column:
            lines.append(start.rstrip())
            start = " " * column
        wrapped = textwrap.wrap(text, width - column)
        lines += [(" " * column if i else start) + line for i, line in enumerate(wrapped)]
    return "\n".join(lines) + "\n\n"
