"""``sceneexpander COMMAND``: what a user sees who has not read anything."""

from __future__ import annotations

import contextlib
import shlex
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from sceneexpander.cli.commands import COMMANDS, Command
from sceneexpander.cli.completion import SHELLS, make_script
from sceneexpander.cli.main import main
from sceneexpander.commandline import CommandParser

ROOT = Path(__file__).parents[3]
HEAVY = ("torch", "numpy", "cv2", "hydra", "mlflow", "dvc", "yaml", "shtab")


def parser_of(command: Command) -> CommandParser:
    made: CommandParser = import_module(command.module).make_parser()
    return made


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line of a command that ends with exit code 2."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_help_lists_every_command_in_one_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    for command in COMMANDS:
        assert [line for line in lines if line.split()[:1] == [command.name] and line.endswith(command.summary)]


def test_the_list_of_commands_imports_nothing_heavy() -> None:
    script = (
        "import sys; from sceneexpander.cli.main import main; main(['--help']); "
        f"print(sorted(set({HEAVY!r}) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_without_a_command_they_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    line = refusal(capsys)
    assert all(command.name in line for command in COMMANDS)


@pytest.mark.parametrize(("typed", "meant"), [("expnad", "expand"), ("EXPAND", "expand"), ("abblation", "ablation")])
def test_misspelt_commands(capsys: pytest.CaptureFixture[str], typed: str, meant: str) -> None:
    assert refusal(capsys, typed) == f"error: {typed}: unknown command; did you mean '{meant}'?"


@pytest.mark.parametrize(
    ("arguments", "missing"), [(["expand"], "PHOTOS"), (["view"], "folder"), (["convert", "a.pt"], "target")]
)
def test_missing_arguments_are_named(capsys: pytest.CaptureFixture[str], arguments: list[str], missing: str) -> None:
    line = refusal(capsys, *arguments)
    assert line.startswith(f"error: sceneexpander {arguments[0]}: the following arguments are required: {missing};")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["expand", "a", "--promt", "x"], "--promt: unknown option; did you mean '--prompt'?"),
        (["plan", "--jsn"], "--jsn: unknown option; did you mean '--json'?"),
        (["ablation", "--finnished"], "--finnished: unknown option; did you mean '--finished'?"),
        (["sweep", "--multirn", "seed=1"], "--multirn: unknown option; did you mean '--multirun'?"),
        (["ui", "--port", "x"], "sceneexpander ui: argument --port: invalid int value: 'x'"),
        (["completion", "bsh"], "bsh: unknown shell; did you mean 'bash'?"),
    ],
)
def test_misspelt_options_and_values(capsys: pytest.CaptureFixture[str], arguments: list[str], expected: str) -> None:
    assert refusal(capsys, *arguments).removeprefix("error: ").startswith(expected)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_example_is_a_command_line_that_the_command_takes(command: Command) -> None:
    parser = parser_of(command)
    assert parser.prog == f"sceneexpander {command.name}"
    assert parser.examples
    for example in parser.examples:
        parser.parse_intermixed_args(shlex.split(example.partition(" > ")[0]))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_help_of_a_command_shows_its_examples(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.suppress(SystemExit):
        import_module(command.module).main(["--help"])
    shown = capsys.readouterr().out
    assert all(f"  sceneexpander {command.name} {example}".rstrip() in shown for example in parser_of(command).examples)


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_knows_every_command_and_its_options(shell: str) -> None:
    script = make_script(shell)
    assert all(command.name in script for command in COMMANDS)
    assert "allow-host" in script


@pytest.mark.parametrize(("words", "expected"), [(["ab"], "ablation"), (["ablation", "--fin"], "--finished")])
def test_bash_completes_commands_and_options(tmp_path: Path, words: list[str], expected: str) -> None:
    (tmp_path / "script").write_text(make_script("bash"))
    ask = (
        "source ./script; complete=$(complete -p sceneexpander); function=${complete#*-F }; COMP_CWORD=$#; "
        'COMP_WORDS=(sceneexpander "$@"); ${function%% *} sceneexpander "${!#}" sceneexpander; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", ask, "bash", *words], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [expected]


@pytest.mark.parametrize(
    "module",
    [command.module for command in COMMANDS if command.name not in ("run", "check", "completion")],
)
def test_the_module_of_a_command_can_be_run_as_well(module: str) -> None:
    found, short = find_spec(module), find_spec(module.replace(".cli.", "."))
    assert found is not None
    assert short is not None
    assert found.origin is not None
    assert short.origin == found.origin
    assert 'if __name__ == "__main__":\n' in Path(found.origin).read_text(encoding="utf-8")


@pytest.mark.parametrize("program", ["sceneexpander", "sceneexpander.plan"])
def test_without_the_script_python_finds_the_commands(program: str) -> None:
    line = [sys.executable, "-m", program, "--help"]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: sceneexpander ")


def test_check_looks_at_the_project_from_any_folder_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT / "docs")
    monkeypatch.delenv("SCENEEXPANDER_ROOT", raising=False)
    with pytest.raises(SystemExit) as caught:
        main(["check"])
    assert caught.value.code is None
    assert "in order" in capsys.readouterr().out
