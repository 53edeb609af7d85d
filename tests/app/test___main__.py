import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import app.__main__ as main


def test_the_exit_code_is_that_of_the_command(monkeypatch):
    received = []
    monkeypatch.setattr(main, "run", lambda arguments: received.append(arguments) or 2)
    monkeypatch.setattr("app.interrupts.install", lambda: None)
    monkeypatch.setattr(sys, "argv", ["nodeslam", "pack", "--seed", "3"])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 2 and received == [["pack", "--seed", "3"]]


def test_thread_pools_are_limited_before_numpy_is_imported():
    code = (
        "import os, sys; os.environ.pop('OPENBLAS_NUM_THREADS', None); import app.__main__; "
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "1", done.stderr


def test_a_locale_without_unicode_is_no_obstacle():
    code = "import app.__main__ as m; m.run = lambda arguments: print('m\\u00b3') or 0; m.main()"
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout) == (0, "m\\xb3\n"), done.stderr


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_replaced_before_a_file_gets_their_descriptors(tmp_path, closed):
    code = (
        "import os, sys, app.__main__ as m\n"
        "def run(arguments):\n"
        "    print('lost'); print('lost', file=sys.stderr); sys.stdin.read()\n"
        "    with open('file', 'w') as file: return 0 if file.fileno() > 2 else 5\n"
        "m.run = run; m.main()"
    )
    (tmp_path / "code.py").write_text(code)
    environment = os.environ | {"PYTHONPATH": str(Path(main.__file__).parents[1])}
    line = f"{sys.executable} code.py {closed}"
    done = subprocess.run(
        ["bash", "-c", line], cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, env=environment
    )
    assert done.returncode == 0 and (tmp_path / "file").read_text() == "", done.stderr


def test_a_run_goes_on_when_its_progress_cannot_be_written():
    code = (
        "import sys, app.__main__ as m\n"
        "def run(arguments):\n"
        "    print('lost' * 5000, file=sys.stderr); print('result'); return 0\n"
        "m.run = run; m.main()"
    )
    line = f"{sys.executable} -c {shlex.quote(code)} 2>/dev/full"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "result\n")


@pytest.mark.parametrize(("variable", "shown"), [("", False), ("default", True)])
def test_warnings_of_libraries_are_shown_on_request(variable, shown):
    code = (
        "import sys, types, warnings, app.__main__ as m; cli = types.ModuleType('app.cli'); "
        "cli.run = lambda arguments: warnings.warn('overflow') or 0; sys.modules['app.cli'] = cli; "
        "import app; app.cli = cli; m.run([])"
    )
    environment = os.environ | {"PYTHONWARNINGS": variable}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and ("overflow" in done.stderr) == shown, done.stderr


def test_help_whose_reader_has_ended_says_nothing():
    environment = os.environ | {"PYTHONPATH": str(Path(main.__file__).parents[1])}
    script = f"set -o pipefail; {sys.executable} -m app pack --help | true"
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, env=environment, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
