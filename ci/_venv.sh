# Sourced by the other scripts of this folder: makes .venv with everything the project needs, once, and puts it on the PATH.
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"

supported() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2> /dev/null; }

if [ -n "${PYTHON:-}" ]; then
  candidates=("$PYTHON")
else
  candidates=(python3.11 python3 python3.12 python3.13)  # 3.11 first: PyBullet has wheels for it only
fi
python=
for candidate in "${candidates[@]}"; do
  if supported "$candidate"; then
    python=$candidate
    break
  fi
done
if [ -z "$python" ]; then
  echo "xreset needs Python 3.11, 3.12 or 3.13; not found among: ${candidates[*]}. Set PYTHON=/path/to/python." >&2
  exit 1
fi

lock=ci/locks/py$("$python" -c 'import sys; print("%d%d" % sys.version_info[:2])').txt
stamp=.venv/.xreset-$(cat pyproject.toml "$lock" | sha256sum | cut -c 1-16)
if [ ! -e "$stamp" ]; then
  echo "== setting up .venv with $("$python" --version) (once; 3 GB, or 7 GB with torch's CUDA build)"
  version=$("$python" -c 'import sys; print(sys.version_info[:2])')
  if [ -x .venv/bin/python ] && [ "$(.venv/bin/python -c 'import sys; print(sys.version_info[:2])')" != "$version" ]; then
    rm -rf .venv  # made with another version of Python
  fi
  [ -x .venv/bin/python ] || "$python" -m venv .venv
  # --no-compile: pip compiles 245 MB of Python on one core; Python compiles the third that it imports, on all cores
  install() { .venv/bin/python -m pip install --disable-pip-version-check --only-binary :all: --no-compile "$@"; }
  # torch first: what depends on it then takes this build
  if nvidia-smi -L > /dev/null 2>&1; then
    install torch==2.13.0
  elif ! install torch==2.13.0+cpu 2> /dev/null; then
    echo "pip's index has no CPU build of torch, so its CUDA build is installed. PyTorch has an index of CPU builds (pytorch.org):"
    echo "to use it, stop, and set PIP_EXTRA_INDEX_URL."
    install torch==2.13.0
  fi
  if [ "$(uname -m)" = x86_64 ]; then
    install --no-deps --require-hashes -r "$lock"  # the versions with which the tests have passed
  fi
  install --quiet -e '.[all,dev]'
  rm -f .venv/.xreset-*
  touch "$stamp"
fi
unset PYTHONDONTWRITEBYTECODE  # else every process compiles all packages that it imports
export PATH="$root/.venv/bin:$PATH"
