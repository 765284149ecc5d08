"""Nothing that somebody wrote into YAML is lost, or turned into something else, without a word."""

from __future__ import annotations

from pathlib import Path

import pytest

from sceneexpander.errors import UserError
from sceneexpander.yamlfile import LIMIT_BYTES, read_user_yaml

pytestmark = pytest.mark.timeout(30)
SENTENCES = ("prompt", "motion")


def read(root: Path, content: str | bytes) -> object:
    path = root / "a.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_user_yaml(path, sentences=SENTENCES, numbers_as_text=True)


def refusal(root: Path, content: str | bytes) -> str:
    with pytest.raises(UserError) as caught:
        read(root, content)
    line = caught.value.line()
    assert "\n" not in line
    assert len(line) < 500
    line.encode()
    return line


@pytest.mark.parametrize(
    "written",
    [
        *(
            "2020-01-01",
            "2020-13-45",
            "2001-12-14 21:59:43.10 -5",
            "12:30",
            "1_000",
            "007",
            "0x10",
            "1e400",
            ".5",
            ".inf",
        ),
        *("A bench#5 here", "'Sign #5'", '"Behind the table: a bench"', "yesterday", "C:\\photos", "9" * 5000, "A = b"),
        "It's 5 o'clock",
    ],
)
def test_what_stands_there_is_what_is_read(tmp_path: Path, written: str) -> None:
    text = written[1:-1] if written[0] in "'\"" else written
    assert read(tmp_path, f"rounds:\n  - prompt: {written}\n    other: 1\n") == {
        "rounds": [{"prompt": text, "other": "1"}]
    }
    assert read(tmp_path, f"prompt: {written}") == {"prompt": text}


@pytest.mark.parametrize(
    "content",
    [
        "prompt: Sign #5 on the wall\n",
        "rounds:\n- prompt: Sign #5\n  other: 1\n",
        "prompt: #5\n",
        "prompt: A sign\n   #5 on the wall\n",
        "prompt: A sign\n  on the\n  wall #5\n",
        "motion: turn # left\n",
        "prompt: &c A bench\n",
    ],
)
def test_sentences_of_which_yaml_drops_a_part_are_refused(tmp_path: Path, content: str) -> None:
    assert "quote it: " in refusal(tmp_path, content)


@pytest.mark.parametrize(
    "content",
    [
        "name: x  # a comment\nprompt: A bench\n",
        "prompt: 'A bench'  # a comment\n",
        "prompt: A bench\n# a comment\nmotion: left\n",
        "rounds:\n  - prompt: A bench\n  # a comment\n  - prompt: A bench\n",
        "prompt: |\n  A bench\n  #5\n",
        "{prompt: A bench}  # a comment",
    ],
)
def test_other_comments_are_comments(tmp_path: Path, content: str) -> None:
    assert "A bench" in str(read(tmp_path, content))


@pytest.mark.parametrize(
    "content",
    [
        "prompt: Behind the table: a bench\n",
        'prompt: "Big" sign on the wall\n',
        "prompt: 'It's a bench'\n",
        "rounds:\n  - prompt: Behind: a bench\n",
        "rounds: [{prompt: Behind: a bench}]\n",
        "prompt: [red] bench: old\n",
        "prompt: @home\n",
        "prompt: `bench`\n",
        "prompt: *star\n",
        "prompt: %5 more\n",
        "prompt: !important bench\n",
        "prompt: > bench\n",
    ],
)
def test_sentences_that_are_no_yaml_are_to_be_quoted(tmp_path: Path, content: str) -> None:
    line = refusal(tmp_path, content)
    assert "quote the sentence: prompt:" in line
    assert "line " in line


@pytest.mark.parametrize("word", ["yes", "No", "on", "OFF", "true"])
def test_words_that_yaml_takes_for_truth_values(tmp_path: Path, word: str) -> None:
    assert f'quote it: prompt: "{word}"' in refusal(tmp_path, f"prompt: {word}\n")
    assert read(tmp_path, f"prompt: '{word}'\n") == {"prompt": word}


@pytest.mark.parametrize(
    "content",
    ["a: 1\na: 1\n", "rounds: []\nx: 1\nrounds: [1]\n", "r: [{prompt: a, prompt: b}]", "1: a\n1: b\n", "'a': 1\na: 2"],
)
def test_equal_keys_are_refused(tmp_path: Path, content: str) -> None:
    assert "twice (line" in refusal(tmp_path, content)


_DOUBLED = "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
_MERGED = "a0: &a0 {k: 1}\n" + "".join(f"a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}\n" for k in range(1, 40))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a: 1".encode("utf-16"), "UTF-16"),
        ("a: 1\nb: 2\n".encode("utf-16-le"), "UTF-16"),
        ("a: 1".encode("utf-32"), "UTF-32"),
        (b"a: K\xfcche", "not UTF-8"),
        (b"a: 1\0", "NUL"),
        ('a: "x\\0y"', "not valid text"),
        ('a: "x\\ud800y"', "not valid text"),
        ('"x\\ud800y": 1', "not valid text"),
        (_DOUBLED, "more values"),
        (_MERGED, "more values"),
        ("a: &a [*a]", "contains itself"),
        ("[" * 20_000, "nested too deeply"),
        ("{a: " * 20_000, "nested too deeply"),
        ("\n".join(" " * k + "- " for k in range(600)), "nested too deeply"),
        ("a: " + "x" * LIMIT_BYTES, "larger than"),
        ("a: !!timestamp 2020-13-45", "not valid YAML"),
        ("a: !!float ''", "not valid YAML"),
        ("a: !!bool maybe", "not valid YAML"),
        ("a: !!python/object/apply:os.getcwd []", "not valid YAML"),
        ("a: 1\n---\nb: 2\n", "not valid YAML"),
        ("a:\n\t- 1\n", "not valid YAML"),
        ("{[1]: 2}", "not valid YAML"),
        ("a: \x1b[31m", "not valid YAML"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path: Path, content: str | bytes, expected: str) -> None:
    assert expected in refusal(tmp_path, content)


@pytest.mark.parametrize(
    "content", ["a: 1\r\nb: ü😀\r\n", "\ufeffa: 1\nb: ü😀\n", "x: &x {a: 1}\ny: {<<: *x, b: ü😀}\n"]
)
def test_harmless_forms_are_read(tmp_path: Path, content: str) -> None:
    assert "ü😀" in str(read(tmp_path, content))


def test_numbers_are_numbers_unless_text_is_wanted(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 7\nb: 0.5\nc: null\nd: true\ne: 2020-01-01\n")
    assert read_user_yaml(path) == {"a": 7, "b": 0.5, "c": None, "d": True, "e": "2020-01-01"}
    path.write_text("a: !!int x")
    with pytest.raises(UserError, match="not valid YAML"):
        read_user_yaml(path)
    path.write_text("a: " + "9" * 5000)
    with pytest.raises(UserError, match="a number of 5000 characters"):
        read_user_yaml(path)


def test_an_empty_file_is_nothing(tmp_path: Path) -> None:
    assert read(tmp_path, "") is None
    assert read(tmp_path, "# only a comment\n") is None
