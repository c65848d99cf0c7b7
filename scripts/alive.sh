#!/usr/bin/env bash
# Runs a command that may be silent for long, such as cargo: alive.sh COMMAND [ARGUMENT…]
#
# On a terminal cargo shows a bar by itself. Elsewhere a line says every eight seconds of silence that the command still runs.
set -euo pipefail
if [ -t 2 ]; then exec "$@"; fi
"$@" 2>&1 | while true; do
  status=0
  IFS= read -r -t 8 line || status=$?
  if [ "$status" = 0 ]; then
    printf '%s\n' "$line"
  elif [ -n "$line" ]; then # a line whose end hasn't come yet, or never will
    printf '%s' "$line"
  elif [ "$status" -gt 128 ]; then
    printf '    … still running after %d s\n' "$SECONDS"
  fi
  [ "$status" = 0 ] || [ "$status" -gt 128 ] || break
done
