# The same commands as .ci/run, one by one. `just` lists them.

export RUSTDOCFLAGS := "-D warnings"

# List the recipes
default:
    @just --list

# Everything that must hold before a change lands
check:
    .ci/run

# All tests; the README's command
test *args:
    cargo test --release {{args}}

# From nothing to a report
quickstart *args:
    cargo run --release -- quickstart {{args}}

# Format the code
fmt:
    cargo fmt

# Lints, warnings as errors
clippy:
    cargo clippy --locked --release --all-targets -- -D warnings

# Documentation, private items included
doc:
    cargo doc --locked --release --no-deps --document-private-items

# Take the new `--help` texts as the expected ones; read the diff before you commit
snapshots:
    INSTA_UPDATE=always cargo test --release --test it cli::

# Licences, sources and duplicates of the dependencies (needs cargo-deny; `cargo deny check advisories` needs the network)
deny:
    cargo deny check bans licenses sources

# The published values of datasets/tables, from the files (needs python3)
tables:
    python3 datasets/tables/make.py

# The stores in other people's readers: pyarrow, polars, duckdb, pandas, datasets, mcap, foxglove, rerun, pymcap-cli (needs python3 with venv, and PyPI)
interop:
    tests/interop/run.sh

# Kills training runs at random moments, resumes them and compares their bytes (needs a release build)
kill-training *args:
    tests/interop/kill_training.sh {{args}}

# Kills recordings at random moments and recovers them (needs a release build and python3)
kill *args:
    tests/interop/kill.sh {{args}}
