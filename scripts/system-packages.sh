#!/bin/sh
# What pip cannot install: the venv module, and a libLLVM that Mitsuba can use, for speed; given the argument
# "chromium", the browser that the report is tested in. All are installed where we may (root on Debian or Ubuntu);
# else this says what is missing.
set -u
python=${PYTHON:-python3}

install() {
    [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null || return 1
    export DEBIAN_FRONTEND=noninteractive
    apt-get install -y -qq "$@" >/dev/null 2>&1 && return 0
    apt-get update -qq >/dev/null 2>&1 && apt-get install -y -qq "$@" >/dev/null 2>&1
}

if [ "${1:-}" = chromium ]; then
    command -v chromium >/dev/null || install chromium ||
        echo "nlt: no chromium: the tests of the report will fail; apt-get install chromium" >&2
    exit 0
fi

if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    install python3-venv || { echo "nlt: install python3-venv first: apt-get install python3-venv" >&2; exit 1; }
fi

ls /usr/lib/*/libLLVM*19* /usr/lib/*/libLLVM*18* /usr/lib/*/libLLVM*17* >/dev/null 2>&1 ||
    install libllvm19 || install libllvm18 || install libllvm17 ||
    echo "nlt: no recent libLLVM: rendering works, slower; apt-get install libllvm19 makes it faster" >&2
exit 0
