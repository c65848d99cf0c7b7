#!/usr/bin/env bash
# Runs the trials of docs/comparison.md: five runners and nerf-sr on a stage that writes half of a file, waits, and writes the rest.
#
#   scripts/compare-runners.sh        after `make bench-runner`, which installs DVC and Snakemake; this script installs ninja and just
set -u
root=$(cd "$(dirname "$0")/.." && pwd)
work=$root/out/compare-runners
venv=$root/out/bench-runner/venv
"$venv/bin/pip" install --quiet ninja==1.13.2 rust-just==1.59.0 || exit 1
export PATH=$venv/bin:$root/target/release:$PATH DVC_NO_ANALYTICS=1
rm -rf "$work"

tools="make ninja just dvc snakemake nerf-sr"
for tool in $tools; do
  mkdir -p "$work/$tool/data"
  cd "$work/$tool" || exit 1
  cat > step.sh <<'END'
#!/bin/sh
if [ "$1" = describe ]; then
  echo '{"name": "step", "version": "1", "code": "1", "summary": "Steps.", "parameters": {"type": "object"}, "output": {"kind": "text"},
    "inputs": {"a": {"kinds": ["text"], "summary": "a text"}}}'
  exit
fi
in=data/in; out=out; home=.
if [ "$1" = --params ]; then home=$(dirname "$0"); in=$home/data/in; mkdir "$4"; out=$4/out; fi
echo ran >> "$home/ran"; cat "$in" > "$out"; sleep "$(cat "$home/nap")"; echo end >> "$out"
END
  chmod +x step.sh
  echo x > data/in
done
printf 'out: data/in\n\t./step.sh\n' > "$work/make/Makefile"
printf 'rule step\n  command = ./step.sh\nbuild out: step data/in\n' > "$work/ninja/build.ninja"
printf 'set unstable\n[script("sh")]\n[cache(inputs = "data/in", outputs = "out")]\nout:\n  ./step.sh\n' > "$work/just/justfile"
printf "stages:\n  step:\n    cmd: ./step.sh\n    deps: [data/in]\n    outs: [out]\n" > "$work/dvc/dvc.yaml"
printf "rule step:\n    input: 'data/in'\n    output: 'out'\n    shell: './step.sh'\n" > "$work/snakemake/Snakefile"
printf 'default: [step]\nstages:\n  step: {run: ./step.sh, inputs: {a: ./data}}\n' > "$work/nerf-sr/pipeline.yaml"
(cd "$work/dvc" && dvc init --no-scm --quiet)

run() {
  case $1 in
    make) make -s out ;; ninja) ninja out ;; just) just out ;; dvc) dvc repro -q ;; snakemake) snakemake -q all --cores 1 out ;; nerf-sr) nerf-sr run ;;
  esac
}
runs() { wc -l < ran; }
result() { if [ "$1" = nerf-sr ]; then ls -t .nerf-sr/objects/*/out | head -1; else echo out; fi; }

for tool in $tools; do
  cd "$work/$tool" || exit 1
  echo 0 > nap; run "$tool" > log 2>&1; sleep 1.1
  touch data/in; run "$tool" > log 2>&1
  echo "$tool: stage runs after a touch without a change: $(runs)"

  echo y > data/in; echo 5 > nap; before=$(runs)
  export -f run; setsid bash -c "run $tool" > log 2>&1 & leader=$!
  for _ in $(seq 100); do [ "$(runs)" -gt "$before" ] && break; sleep 0.1; done; sleep 0.3
  ps -eo pid,sid | awk -v s="$leader" '$2 == s { print $1 }' | xargs -r kill -9 2> /dev/null; pkill -9 -f "$work/$tool/step.sh"; sleep 0.5
  echo 0 > nap; before=$(runs); run "$tool" > log 2>&1
  echo "$tool: after kill -9 halfway: exit code $?, stage runs: $(($(runs) - before)), result: $(tr '\n' ' ' < "$(result "$tool")")"
  if [ "$tool" = snakemake ]; then
    snakemake --unlock > log 2>&1; snakemake -q all --cores 1 --rerun-incomplete out > log 2>&1
  fi

  echo z > data/in; echo 3 > nap; before=$(runs)
  run "$tool" > first 2>&1 & sleep 2
  run "$tool" > second 2>&1; second=$?; wait $!
  echo "$tool: two concurrent runs: exit code of the second $second, stage runs of both: $(($(runs) - before))"

  echo 0 > nap; run "$tool" > log 2>&1; file=$(result "$tool"); time=$(stat -c %y "$file"); before=$(runs)
  printf Q | dd of="$file" bs=1 conv=notrunc 2> /dev/null; touch -d "$time" "$file"; run "$tool" > log 2>&1
  echo "$tool: stage runs after a changed byte with an unchanged time: $(($(runs) - before))"
done 2>&1 | grep -v Killed
cd "$work/nerf-sr" && nerf-sr verify | tail -1
