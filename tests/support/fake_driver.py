"""OpenCL drivers that fail: PoCL behind a library that spoils one function, built with the C compiler."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.selection import skip_or_fail

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

/* Places in the table of functions that every object of a driver points to. */
enum { CREATE_PROGRAM = 26, BUILD_PROGRAM = 30 };
typedef void *(*address_fn)(const char *);
typedef int32_t (*platforms_fn)(uint32_t, void **, uint32_t *);
typedef void *(*create_fn)(void *, uint32_t, const char **, const size_t *, int32_t *);
typedef int32_t (*build_fn)(void *, uint32_t, void *const *, const char *, void *, void *);

static void *library;
static create_fn create;
static build_fn build;
static void *refused[4096];
static int refusals;

static void *real(const char *name) {
    if (!library) library = dlopen(REAL, RTLD_NOW | RTLD_LOCAL);
    return library ? dlsym(library, name) : NULL;
}

static int mentions(const char **texts, uint32_t count, const char *word) {
    for (uint32_t i = 0; i < count; i++)
        if (texts[i] && strstr(texts[i], word)) return 1;
    return 0;
}

static void *create_program(void *context, uint32_t count, const char **texts, const size_t *sizes, int32_t *error) {
    if (!strcmp(MODE, "wrong") && count == 1 && mentions(texts, count, WORD)) {
        char *text = strdup(texts[0]);
        for (char *at = text; (at = strstr(at, WORD)); at += strlen(WORD)) memcpy(at, INSTEAD, strlen(WORD));
        return create(context, 1, (const char **)&text, NULL, error);
    }
    void *program = create(context, count, texts, sizes, error);
    if (mentions(texts, count, WORD) && refusals < 4096) refused[refusals++] = program;
    return program;
}

static int is_refused(void *program) {
    for (int i = 0; i < refusals; i++)
        if (refused[i] == program) return 1;
    return 0;
}

static int32_t build_program(void *program, uint32_t count, void *const *devices, const char *options, void *notify,
                             void *data) {
    if (is_refused(program)) {
        if (!strcmp(MODE, "abort")) abort();
        if (!strcmp(MODE, "hang")) for (;;) pause();
        if (!strcmp(MODE, "refuse")) return -11;
    }
    return build(program, count, devices, options, notify, data);
}

static int32_t platforms(uint32_t most, void **found, uint32_t *number) {
    int32_t error = ((platforms_fn)((address_fn)real("clGetExtensionFunctionAddress"))("clIcdGetPlatformIDsKHR"))(
        most, found, number);
    if (error || !found) return error;
    void **table = *(void ***)found[0];
    if (table[BUILD_PROGRAM] == (void *)build_program) return 0;
    uintptr_t page = (uintptr_t)table & ~(uintptr_t)4095;
    mprotect((void *)page, 8192, PROT_READ | PROT_WRITE);
    create = (create_fn)table[CREATE_PROGRAM];
    build = (build_fn)table[BUILD_PROGRAM];
    table[CREATE_PROGRAM] = (void *)create_program;
    table[BUILD_PROGRAM] = (void *)build_program;
    return 0;
}

void *clGetExtensionFunctionAddress(const char *name) {
    if (!strcmp(MODE, "load")) abort();
    if (!strcmp(MODE, "exit")) _exit(0);
    if (!strcmp(name, "clIcdGetPlatformIDsKHR")) return (void *)platforms;
    return ((address_fn)real("clGetExtensionFunctionAddress"))(name);
}

int32_t clGetPlatformInfo(void *platform, uint32_t what, size_t size, void *value, size_t *needed) {
    return ((int32_t (*)(void *, uint32_t, size_t, void *, size_t *))real("clGetPlatformInfo"))(
        platform, what, size, value, needed);
}
"""


def pocl_library() -> str:
    """Return the library of PoCL's wheel; skip the test without it."""
    import pyopencl

    found = sorted((Path(pyopencl.__file__).parent / ".libs").glob("libpocl*.so*"))
    if not found:
        skip_or_fail("opencl", "PoCL's wheel is not installed")
    return str(found[0])


def build(folder: Path, mode: str, word: str = "distance", instead: str = "") -> Path:
    """Build a driver and its ``.icd`` file.

    Args:
        folder: The folder for the library and ``vendors``.
        mode: ``"abort"``, ``"hang"`` or ``"refuse"`` when it builds a program, ``"wrong"`` to change what a program
            computes, ``"load"`` to abort when it is loaded, ``"exit"`` to end the process then with status 0,
            ``""`` for none of these.
        word: A text of the programs that it spoils.
        instead: The text of the same length that replaces it in a wrong program.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if not sys.platform.startswith("linux"):
        pytest.skip("a fake driver needs Linux's loader")
    if compiler is None:
        skip_or_fail("opencl", "a fake driver needs a C compiler: none is on the search path as cc or gcc")
    library, source = folder / f"lib{mode or 'plain'}.so", folder / f"{mode or 'plain'}.c"
    source.write_text(SOURCE)
    words = {"REAL": pocl_library(), "MODE": mode, "WORD": word, "INSTEAD": instead}
    defines = [f'-D{name}="{value}"' for name, value in words.items()]
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", *defines, str(source), "-o", str(library), "-ldl"], check=True)
    vendors = folder / "vendors"
    vendors.mkdir(exist_ok=True)
    icd = vendors / f"{mode or 'plain'}.icd"
    icd.write_text(f"{library}\n")
    return icd


def environment(folder: Path, **variables: str) -> dict[str, str]:
    """Return the environment of a process with a cold cache."""
    (folder / "temporary").mkdir(exist_ok=True)
    places = {
        "GPUSENSE_CACHE_DIR": str(folder / "cold"),
        "XDG_CACHE_HOME": str(folder / "xdg"),
        "TMPDIR": str(folder / "temporary"),
    }
    dropped = ("GPUSENSE_BACKEND", "GPUSENSE_PROOF", "GPUSENSE_CACHE", "OCL_ICD_VENDORS")
    return {name: value for name, value in os.environ.items() if name not in dropped} | places | variables
