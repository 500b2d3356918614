#!/bin/bash
# Kills a short training run at random moments (SIGKILL, SIGTERM, SIGINT), resumes it until it is done, and compares every
# file of its directory, timings.parquet excepted, with those of a run that was never stopped.
# usage: tests/interop/kill_training.sh [TIMES] [WORK_DIR]   (default 20; needs target/release/ccmarl)
set -u
cd "$(dirname "$0")/../.."
times=${1:-20}
work=$(mktemp -d "${2:-${TMPDIR:-/tmp}}/ccmarl-kill-training.XXXXXX")
trap 'rm -rf "$work"' EXIT
ccmarl=${CCMARL:-target/release/ccmarl}
RANDOM=${SEED:-1}
failed=0

cat >"$work/run.toml" <<'TOML'
algorithm = "cc-maddpg"
steps = 30000
log_every = 7
checkpoint_every = 3
replay = 5000
scenario = { name = "simple_spread" }
[maddpg]
batch = 128
[dumie]
batch = 128
[evaluation]
protocol = "standard"
every = 5000
TOML

sums() { (cd "$1" && find . -type f ! -name timings.parquet | sort | xargs sha256sum); }

start=$(date +%s%N)
"$ccmarl" train --config "$work/run.toml" --out "$work/whole" >/dev/null 2>"$work/err" || { cat "$work/err"; exit 1; }
whole=$((($(date +%s%N) - start) / 1000000))
sums "$work/whole" >"$work/expected"

kills=0 nothing=0 gone_on=0 finished=0
run=0
while [ $kills -lt "$times" ]; do
    run=$((run + 1))
    out="$work/killed"
    rm -rf "$out" "$work/.killed.partial"
    code=1
    while [ $code != 0 ]; do
        if [ -e "$out" ]; then
            "$ccmarl" train --out "$out" --resume >/dev/null 2>"$work/err" &
        else
            "$ccmarl" train --config "$work/run.toml" --out "$out" >/dev/null 2>"$work/err" &
        fi
        pid=$!
        if [ $kills -lt "$times" ]; then
            # most fall into the run, some into its first milliseconds
            wait_ms=$((RANDOM % 5 == 0 ? RANDOM % 60 : RANDOM % (whole * 6 / 10)))
            sleep "$(printf '%d.%03d' $((wait_ms / 1000)) $((wait_ms % 1000)))"
            signal=$(case $((RANDOM % 4)) in 0) echo TERM ;; 1) echo INT ;; *) echo KILL ;; esac)
            if kill -$signal $pid 2>/dev/null; then kills=$((kills + 1)); fi
        fi
        wait $pid 2>/dev/null
        code=$?
        case $code in
        0) finished=$((finished + 1)) ;;
        4 | 137 | 130 | 143) if [ -e "$out" ]; then gone_on=$((gone_on + 1)); else nothing=$((nothing + 1)); fi ;;
        *)
            echo "FAILED: exit code $code: $(cat "$work/err")"
            exit 1
            ;;
        esac
    done
    sums "$out" >"$work/found"
    if ! cmp -s "$work/expected" "$work/found"; then
        echo "FAILED run $run:"
        diff "$work/expected" "$work/found"
        failed=$((failed + 1))
    fi
done
echo "$kills kills in $run runs of $whole ms: $gone_on left a run that went on, $nothing came before there was one;" \
    "$((run - failed)) of $run runs ended with the bytes of one that was never stopped ($(wc -l <"$work/expected") files)"
[ $failed = 0 ] || exit 1
