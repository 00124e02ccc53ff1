"""Check that the words that the glossary replaced stay away: `python .ci/words.py`.

`docs/glossary.md` has the words in use. Names are checked in every Python file, phrases in comments, strings and pages.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


NAMES = _words(
    """
Ordered People Traits Stood GaussSmooth Resilient Ascent Summit Climb Pursuit InModel ByPolicy Lesson Whose
ALIKE Guessed Regulate _Mind _close final_reward with_costs filled_up nats_a_move by_costs pull_back firsts gave_up
sharpness lapses tastes sensed favourite doubtful nameless rehearsals optimise optimiser optimisers maximise minimise
neighbour neighbours neighbouring colour colours centre centres parametrisation whose nobody somebody rivals rival
people peoples summit settled escape to_come
    """
)
"""Identifiers that appear nowhere: neither as a name nor as a part of a dotted one."""

DEFINITIONS = _words(
    """
Lines Smooth Start Sweeps Gradients Learned Hold Said robot careful believed pursue apart counted counting told scores
said surprise tried dealt guesses lag lowest patience moves_on
    """
)
"""Names that no class, function or method of src may have; as words of English they are harmless."""

SOURCE_NAMES = _words("found given how said tried dealt told")
"""Names that no variable or parameter of src may have."""

MODULES = _words(
    """
ordered sweeping passing outwards inwards rounds pairs given host compiled order numbering process choice family
outcomes slips people climb settings rivals domains flats commands terminal scoring runs
    """
)
"""Modules and packages of src that may not exist."""

PHRASES = r"""
comes? to rest|taken for|to be had|\bat all\b|\bso many\b|\bnobody|\bsomebody|\bwhose\b|\bwho\b|\bfavourites?\b
|\bsharpness\b|\brivals?\b|\bsummit\b|\bhow sharply\b|\bsettled\b|\bin vain\b
""".replace("\n", "")
"""What no comment, string or page says."""

OPTIONS = r"--(behavior|unknown|person|candidates|lines|sample|iterations|truth)\b(?!-)"
"""Options of version 0.1, which still work but are not written."""

EXEMPT = {
    ".ci/words.py": "the list",
    "CHANGELOG.md": "names what had which name",
    "src/sidestep/cli/options.py": "has the old options",
    "tests/cli/test_old_options.py": "tests the old options",
}


def files() -> list[Path]:
    """The files of the repository that are checked."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], capture_output=True, text=True, check=True
    )
    paths = (Path(line) for line in listed.stdout.splitlines())
    return [p for p in paths if p.suffix in (".py", ".pyi", ".md") and str(p) not in EXEMPT and p.exists()]


def python_names(path: Path, text: str) -> Iterator[tuple[int, str]]:
    """Forbidden names in a Python file."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        module = token.string == "people" and "benchmarks" in path.parts  # `benchmarks.people`
        if token.type == tokenize.NAME and token.string in NAMES and not module:
            yield token.start[0], f"name {token.string}"
    if path.parts[0] != "src":
        return
    if path.stem in MODULES or path.parent.name in MODULES:
        yield 1, f"module {path}"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            method = node.name == "robot" and node.col_offset > 0  # `LearnedMap.robot()` returns one
            if node.name in DEFINITIONS and not method:
                yield node.lineno, f"definition {node.name}"
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in SOURCE_NAMES:
            yield node.lineno, f"variable {node.id}"
        elif isinstance(node, ast.arg) and node.arg in SOURCE_NAMES:
            yield node.lineno, f"parameter {node.arg}"


def python_prose(text: str) -> Iterator[tuple[int, str]]:
    """The comments and strings of a Python file, line by line."""
    kinds = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in kinds:
            yield token.start[0], token.string


def phrases(prose: Iterator[tuple[int, str]], pattern: str) -> Iterator[tuple[int, str]]:
    """Forbidden phrases in prose; phrases may run over the end of a line."""
    for first, text in prose:
        flat = re.sub(r"\s*\n[\s#]*", lambda match: " " * len(match.group()), text)
        for match in re.finditer(pattern.replace(" ", r"\s+"), flat, re.IGNORECASE):
            yield first + text[: match.start()].count("\n"), f"phrase {' '.join(match.group().split())!r}"


def main() -> int:
    """Print every forbidden word; return 1 if there is one."""
    results = []
    for path in files():
        text = path.read_text()
        problems: list[tuple[int, str]] = []
        if path.suffix != ".md":
            problems += python_names(path, text)
            if path.parts[0] == "src":
                problems += phrases(python_prose(text), f"{PHRASES}|{OPTIONS}")
        elif path.parts[0] in ("docs", "README.md"):
            problems += phrases(iter([(1, text)]), f"{PHRASES}|{OPTIONS}")
            for line, content in enumerate(text.splitlines(), 1):
                words = re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", content)))
                problems += [(line, f"name {word}") for word in words if word in NAMES]
        results += [f"{path}:{line}: {problem}" for line, problem in sorted(problems)]
    print("\n".join(results))
    return min(len(results), 1)


if __name__ == "__main__":
    sys.exit(main())
