#!/usr/bin/env bash
# Runs a command that may print nothing for minutes, such as cargo: alive.sh COMMAND [ARGUMENT…]
#
# On a terminal cargo prints its own progress bar. Otherwise a line after every eight seconds of silence reports that the command is
# still running.
set -euo pipefail
if [ -t 2 ]; then exec "$@"; fi
"$@" 2>&1 | while true; do
  status=0
  IFS= read -r -t 8 line || status=$?
  if [ "$status" = 0 ]; then
    printf '%s\n' "$line"
  elif [ -n "$line" ]; then # an incomplete line: `read` timed out or reached the end
    printf '%s' "$line"
  elif [ "$status" -gt 128 ]; then
    printf '    … still running after %d s\n' "$SECONDS"
  fi
  [ "$status" = 0 ] || [ "$status" -gt 128 ] || break
done
