#!/usr/bin/env bash
# torch-mist beside ccmarl on iris, in one run: I(sepal; petal) on the command line of each, with its CPU time.
#
#   tests/benches/mist_beside.sh PYTHON OUT
#
# PYTHON has torch and torch-mist. torch-mist 0.2.17 asks for numpy < 2 and plots with mpld3 and scikit-learn; where those do not fit:
#   pip install torch numpy pandas; pip install --no-deps torch-mist hydra-core omegaconf antlr4-python3-runtime==4.9.3 pyro-ppl \
#     pyro-api opt-einsum tqdm scikit-learn joblib threadpoolctl mpld3 narwhals jinja2 markupsafe
# Its CLI reads columns named NAME_1 … NAME_N and its settings as estimation.x_key=; the line in its README, with
# x_key=, ends with an error.
set -euo pipefail
python=$1 out=$2
top=$(cd "$(dirname "$0")/../.." && pwd)
ccmarl=${CCMARL:-${CARGO_TARGET_DIR:-$top/target}/release/ccmarl}
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
table=$top/datasets/tables/iris.csv
# its names of columns
awk -F, 'NR == 1 { print "sepal_1,sepal_2,petal_1,petal_2" } NR > 1 { print $1 "," $2 "," $3 "," $4 }' "$table" >"$dir/iris.csv"

TIMEFORMAT='%U %S'
# cpu NAME COMMAND…: runs it, prints CPU seconds (user and system) and what it printed
cpu() {
    local name=$1 used status=0
    shift
    used=$({ time "$@" >"$dir/log" 2>&1 || status=$?; } 2>&1; exit $status) || status=$?
    awk -v name="$name" -v used="$used" -v status="$status" \
        'BEGIN { split(used, s, " "); printf "%-44s %7.2f CPU s%s\n", name, s[1] + s[2], status ? ", exit " status : "" }'
    tr '\r' '\n' <"$dir/log" | tail -n "${LINES_KEPT:-12}" | sed 's/^/    /'
}

sides=(--x sepal_length,sepal_width --y petal_length,petal_width)
{
    echo "iris, 150 rows, I(sepal; petal); $(date -u +%F), $(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1)"
    "$python" -c 'import importlib.metadata as m, platform; print("Python", platform.python_version(), *(f"{p} {m.version(p)}" for p in ("torch", "torch-mist")))'
    "$ccmarl" --version
    cpu "ccmarl estimate-mi (jsd, club, gaussian)" "$ccmarl" estimate-mi "$table" "${sides[@]}"
    cpu "ccmarl estimate-mi --estimator auto" "$ccmarl" estimate-mi "$table" "${sides[@]}" --estimator auto
    cpu "ccmarl --version (start-up)" "$ccmarl" --version
    mist=(-c 'from scripts.compute_mi import run; run()')
    LINES_KEPT=3 cpu "mist, the line of its README (x_key=)" "$python" "${mist[@]}" data=csv data.filepath="$dir/iris.csv" \
        mi_estimator=js x_key=sepal y_key=petal
    LINES_KEPT=3 cpu "mist mi_estimator=js" "$python" "${mist[@]}" data=csv data.filepath="$dir/iris.csv" \
        mi_estimator=js estimation.x_key=sepal estimation.y_key=petal
    cpu "python -c 'import torch_mist' (start-up)" "$python" -c "import torch_mist"
} | sed "s|$dir/||g" | tee "$out"
