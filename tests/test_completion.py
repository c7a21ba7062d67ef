"""What shells complete of command lines, asked of these shells."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from usdbrdf.command_parser import completion
from usdbrdf.commands import COMMANDS

# What bash falls back to where a function has nothing to say is only seen in a terminal.
_BASH = """
source "$1"; COMP_LINE=$2; read -ra COMP_WORDS <<< "$2"; [[ $2 == *" " ]] && COMP_WORDS+=("")
COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _usdbrdf; printf "%s\\n" "${COMPREPLY[@]}"
complete -p usdbrdf
"""
_ZSH = 'autoload -Uz compinit; compinit -u -D; source "$1"; print -r -- ${_comps[usdbrdf]}'
_FISH = "source $argv[1]; complete -C $argv[2]"


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    folder = tmp_path_factory.mktemp("completion")

    def written(shell):
        if shutil.which(shell) is None:
            pytest.skip(f"needs {shell}")
        file = folder / f"usdbrdf.{shell}"
        file.write_text(completion(shell, COMMANDS), "utf-8")
        return file

    return written


def said(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("usdbrdf conv", ["convert"]),
        ("usdbrdf convert scan --te", ["--texel-size"]),
        ("usdbrdf convert -q --json scan --denoise ", ["auto", "none", "oidn"]),
        ("usdbrdf package room --textures p", ["png"]),
        ("usdbrdf convert s", [""]),
        ("usdbrdf convert -q s", [""]),
        ("usdbrdf convert scan -o out/", [""]),
    ],
)
def test_bash(script, line, found):
    *told, how = said("bash", "-c", _BASH, "bash", str(script("bash")), line)
    assert told == found
    assert how == "complete -o bashdefault -o default -F _usdbrdf usdbrdf"  # files, for ""


def test_zsh(script):
    file = script("zsh")
    assert said("zsh", "-fc", _ZSH, "zsh", str(file)) == ["_cyclopts_usdbrdf"]
    text = file.read_text("utf-8")
    assert "'1:ASSET:_files'" in text
    assert "'--quiet[-q]'" in text  # which takes no value


def test_fish(script, tmp_path):
    (tmp_path / "scan").mkdir()
    file = str(script("fish"))
    for line, first in (
        ("usdbrdf conv", "convert\t"),
        ("usdbrdf convert scan --te", "--texel-size"),
        ("usdbrdf package room --textures p", "png"),
        (f"usdbrdf convert {tmp_path}/sc", f"{tmp_path}/scan/"),
        (f"usdbrdf convert -q {tmp_path}/sc", f"{tmp_path}/scan/"),
    ):
        told = said("fish", "--no-config", "-c", _FISH, file, line)
        assert len(told) == 1
        assert told[0].startswith(first)
