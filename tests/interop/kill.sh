#!/bin/bash
# Kills a recording with SIGKILL at random moments, recovers it, verifies it, and compares it with what stderr reported.
# usage: [FORMS="store store.mcap"] tests/interop/kill.sh [TIMES_PER_FORM] [WORK_DIR]   (default 50; needs target/release/ccmarl and python3)
set -u
cd "$(dirname "$0")/../.."
times=${1:-50}
work=$(mktemp -d "${2:-${TMPDIR:-/tmp}}/ccmarl-kill.XXXXXX")
trap 'rm -rf "$work"' EXIT
ccmarl=${CCMARL:-target/release/ccmarl}
failed=0

fail() {
    echo "FAILED $form run $run: $*"
    failed=$((failed + 1))
}

for form in ${FORMS:-store store.parquet store.mcap}; do
    recovered=0 empty=0 finished=0 beyond=0 reported=0
    for run in $(seq "$times"); do
        out="$work/$form"
        # from before the first episode to after the last: the short recordings are killed while they are sealed, too
        episodes=$((run % 5 == 0 ? 3000 : 100000000))
        "$ccmarl" record --scenario simple_spread --link dropout:0.2 --episodes $episodes --out "$out" \
            >/dev/null 2>"$work/err" &
        pid=$!
        sleep "$(python3 -c "import random; print(random.uniform(0.02, 2.5) if $episodes > 3000 else random.uniform(0.02, 0.9))")"
        kill -9 $pid 2>/dev/null
        wait $pid 2>/dev/null
        committed=$(sed -n 's/^committed \([0-9]*\) episodes$/\1/p' "$work/err" | tail -1)
        committed=${committed:-0}
        reported=$((reported + committed))
        if [ -e "$out" ] && [ ! -e "$work/.$form.partial" ]; then
            finished=$((finished + 1))
        elif [ -e "$work/.$form.partial" ]; then
            "$ccmarl" recover "$out" >"$work/recover" 2>&1
            code=$?
            [ $code = 0 ] || [ $code = 3 ] || [ "$committed" = 0 ] || fail "recover exits $code: $(cat "$work/recover")"
            [ -e "$out" ] && recovered=$((recovered + 1))
        fi
        if [ -e "$out" ]; then
            "$ccmarl" verify "$out" --format json >"$work/verify" 2>&1 || fail "verify exits $?: $(cat "$work/verify")"
            there=$(python3 -c "import json, sys; print(json.load(open(sys.argv[1]))['episodes'])" "$work/verify")
            [ "$there" -ge "$committed" ] || fail "$committed episodes were reported committed, $there are there"
            beyond=$((beyond + there - committed))
        else
            empty=$((empty + 1))
            [ "$committed" = 0 ] || fail "$committed episodes were reported committed, and there is no store"
        fi
        rm -rf "$out" "$work/.$form.partial" "$work/.recovered.$form" "$work/..recovered.$form.partial"
        left=$(find "$work" -mindepth 1 ! -name err ! -name recover ! -name verify)
        [ -z "$left" ] || fail "left behind: $left"
    done
    echo "$form: $times kills: $recovered recovered, $finished had finished, $empty before the first episode;" \
        "$reported episodes reported committed, all there, and $beyond more"
done
[ $failed = 0 ] || exit 1
