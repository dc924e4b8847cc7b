# Sourced by the scripts beside it: makes .venv with everything the project needs, once, and puts it on the PATH.
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
python=${PYTHON:-python3}
stamp=.venv/.xreset-$("$python" -c 'import hashlib,sys; print(hashlib.sha256(open("pyproject.toml","rb").read()).hexdigest()[:16])')
if [ ! -e "$stamp" ]; then
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "xreset needs Python 3.11 or newer, found $("$python" --version 2>&1). Set PYTHON=/path/to/python3.11." >&2
    exit 1
  }
  echo "== setting up .venv (once)"
  [ -x .venv/bin/python ] || "$python" -m venv .venv
  .venv/bin/python -m pip install --quiet --disable-pip-version-check torch==2.13.0  # first: a plain torch would bring CUDA along
  .venv/bin/python -m pip install --quiet --disable-pip-version-check -e '.[all,dev]'
  rm -f .venv/.xreset-*
  touch "$stamp"
fi
export PATH="$root/.venv/bin:$PATH"
