"""The preprocessor of kernel sources: branches against a generator, and refused directives."""

from __future__ import annotations

import random

import pytest

from gpusense.interface.flags import FLAGS
from gpusense.interface.kernel_files import opencl_names, opencl_source
from gpusense.interface.sources import resolve

NAMES = sorted(FLAGS)[:4]


def block(rng, flags, live, depth):
    """Return random lines, and which of them are kept where ``live``."""
    lines, kept = [], []
    for _ in range(rng.randint(1, 4)):
        if depth == 0 or rng.random() < 0.5:
            text = rng.choice([f"int a{rng.randint(0, 99)};", "", "#define LANES 4", "#pragma unroll"])
            lines.append(text)
            kept.append(text if live else "")
            continue
        done, branches = False, ["if", *["elif"] * rng.randint(0, 3), *["else"] * rng.randint(0, 1)]
        for word in branches:
            name, sign = rng.choice(NAMES), rng.choice(["", "!"])
            true = True if word == "else" else (name in flags) != bool(sign)
            space = rng.choice(["", " ", "  "])
            lines.append(f"{space}#{rng.choice(['', ' '])}{word}" + ("" if word == "else" else f" {sign}{name}")
                         + rng.choice(["", "  // why"]))  # fmt: skip
            inner, inner_kept = block(rng, flags, live and true and not done, depth - 1)
            done = done or true
            lines, kept = lines + inner, [*kept, "", *inner_kept]
        lines.append("#endif")
        kept.append("")
    return lines, kept


def test_random_sources_keep_the_branches_of_c():
    rng = random.Random(3)
    for _ in range(400):
        flags = frozenset(name for name in NAMES if rng.random() < 0.5)
        lines, kept = block(rng, flags, True, 4)
        assert resolve("\n".join(lines) + "\n", flags) == "\n".join(kept) + "\n"


def test_a_chain_takes_its_first_true_branch():
    a, b, c = NAMES[:3]
    text = f"#if {a}\none\n#elif {b}\ntwo\n#elif !{c}\nthree\n#else\nfour\n#endif\nend\n"
    for flags, word in (({a, b}, "one"), ({b}, "two"), (set(), "three"), ({c}, "four")):
        found = resolve(text, frozenset(flags)).splitlines()
        assert [line for line in found if line] == [word, "end"] and len(found) == 10


REFUSED = [
    ("#if {a} && {b}", 1), ("#if defined({a})", 1), ("#if", 1), ("#if 1", 1), ("#if NO_SUCH_FLAG", 1),
    ("#if {a}\n#elif NO_SUCH_FLAG\n#endif", 2), ("#if {a}\n#elif\n#endif", 2), ("#ifdef {a}\n#endif", 1),
    ("\n#ifndef {a}\n#endif", 2), ("#if {a}\n#elifdef {b}\n#endif", 2), ("#if {a}\n#elseif {b}\n#endif", 2),
    ("#undef {a}", 1), ('#include "beam.cl"', 1), ("#line 7", 1), ("#error no", 1), ("#", 1), ("#define {a} 1", 1),
    ("#else", 1), ("#elif {a}", 1), ("#if {a}\n#endif\n#endif", 3), ("#if {a}\n#else\n#else\n#endif", 3),
    ("#if {a}\n#else\n#elif {b}\n#endif", 3), ("#if {a}\n#else {b}\n#endif", 2), ("#if {a}\n#endif {a}", 2),
    ("int x;\n#if {a}\n#if {b}\n#endif\n", 2), ("#if \\\n{a}\n#endif", 1),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line"), REFUSED)
def test_what_is_not_resolved_is_refused_with_file_and_line(text, line):
    with pytest.raises(ValueError, match=rf"^beam.cl:{line}: (a directive|#if) must .*, got [^\n]*$"):
        resolve(text.format(a=NAMES[0], b=NAMES[1]), frozenset(), "beam.cl")


def test_macros_of_several_lines_are_left_alone():
    text = "#define TWO(x) \\\n    # x \\\n    x\nint y;\n"
    assert resolve(text, frozenset()) == text


def test_no_directive_of_a_kernel_is_left_to_the_compiler():
    """For any flags, the compiler sees only ``#define`` and ``#pragma``."""
    for name in opencl_names():
        for flags in (frozenset(), frozenset(FLAGS)):
            left = [
                line.split()[0] for line in resolve(opencl_source(name), flags, name).splitlines() if "#" in line[:1]
            ]
            assert set(left) <= {"#define", "#pragma"}, name
