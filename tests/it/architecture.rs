//! Holds the house of ARCHITECTURE.md: who may import whom, which crate belongs to which room, how a plugin file
//! begins and is listed, how long a file may be. Reads the sources as text.

use std::path::Path;

/// Rooms by floor, bottom up. A room imports from floors below its own.
const FLOORS: &[&[&str]] = &[
    &["schema", "error", "registry", "rng", "config", "io"],
    &["nn", "stats"],
    &["algo", "scenario", "link", "storage", "figure"],
    &["record", "pairs", "mi"],
    &["report", "train", "channel", "diagnose"],
    &["cli", "main", "lib"],
];

/// The stages in the data's direction: a later one may use an earlier one.
const STAGES: &[&str] = &["record", "pairs", "mi"];

/// Names that only some rooms may use.
const BORDERS: &[(&[&str], &[&str])] = &[
    (&["plotters"], &["figure"]),
    (&["mcap", "parquet"], &["storage"]),
    (&["candle_core", "candle_nn"], &["nn", "mi", "algo", "train"]),
    (&["anyhow", "indicatif", "comfy_table"], &["cli"]),
];

/// Words that stand nowhere outside tests, and who is excepted.
const FORBIDDEN: &[(&str, &[&str], &str)] = &[
    ("println!", &["cli"], "only cli prints: return the text"),
    ("eprintln!", &["cli"], "only cli prints: return an error"),
    (".unwrap()", &["cli"], "return a typed error"),
    (".expect(", &["cli"], "return a typed error"),
    ("#[allow(", &[], "write #[expect(lint, reason = \"…\")]"),
    ("#![allow(", &[], "write #![expect(lint, reason = \"…\")]"),
    ("HashMap", &[], "its order is not fixed: use BTreeMap"),
    ("HashSet", &[], "its order is not fixed: use BTreeSet"),
];

/// Folders whose files are plugins, listed in a slice of their mod.rs.
const PLUGIN_ROOMS: &[&str] = &["scenario", "link", "record", "mi", "algo", "storage", "figure"];

/// How the documentation of a plugin file is divided.
const HEADINGS: &[&str] = &[
    "# What it is",
    "# Definition",
    "# Shapes and units",
    "# Parameters",
    "# When it fails",
    "# Reference",
    "# Differences from the reference implementation",
];

/// Lines that no file exceeds.
const LONGEST_FILE: usize = 700;

/// A source file: its path below src/, its text, and the text without comments, literals and tests.
struct Source {
    path: String,
    text: String,
    code: String,
}

impl Source {
    fn new(path: &str, text: &str) -> Self {
        Self { path: path.to_owned(), text: text.to_owned(), code: without_tests(&without_literals(text)) }
    }

    /// The folder or file directly below src/.
    fn room(&self) -> &str {
        self.path.split('/').next().unwrap_or("").trim_end_matches(".rs")
    }

    /// The module's own name.
    fn module(&self) -> &str {
        self.path.trim_end_matches("/mod.rs").trim_end_matches(".rs").rsplit('/').next().unwrap_or("")
    }

    fn is_test(&self) -> bool {
        self.module() == "tests" || self.module().ends_with("_tests")
    }
}

/// Every file below src/, sorted by path; whole files of tests left out.
fn sources() -> Vec<Source> {
    fn walk(root: &Path, dir: &Path, found: &mut Vec<Source>) {
        for entry in std::fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(root, &path, found);
            } else if path.extension().is_some_and(|e| e == "rs") {
                let name = path.strip_prefix(root).unwrap().to_str().unwrap().replace('\\', "/");
                found.push(Source::new(&name, &std::fs::read_to_string(&path).unwrap()));
            }
        }
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = Vec::new();
    walk(&root, &root, &mut found);
    found.retain(|source| !source.is_test());
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

/// The text with comments removed and literals emptied; line ends stay.
fn without_literals(text: &str) -> String {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let starts = |i: usize, word: &str| word.chars().enumerate().all(|(k, c)| at(i + k) == c);
    let mut out = String::with_capacity(text.len());
    let mut i = 0;
    // skips to `end`, keeping line ends
    let skip = |out: &mut String, from: usize, end: usize| {
        out.extend(chars[from..end.min(chars.len())].iter().filter(|&&c| c == '\n'));
        end
    };
    while i < chars.len() {
        let word_before = i > 0 && (at(i - 1).is_alphanumeric() || at(i - 1) == '_');
        let hashes = (i + 1..chars.len()).take_while(|&k| at(k) == '#').count();
        if starts(i, "//") {
            i += (i..chars.len()).take_while(|&k| at(k) != '\n').count();
        } else if starts(i, "/*") {
            let end = (i + 2..chars.len()).find(|&k| starts(k, "*/")).map_or(chars.len(), |k| k + 2);
            i = skip(&mut out, i, end);
        } else if at(i) == 'r' && !word_before && at(i + 1 + hashes) == '"' {
            let close = format!("\"{}", "#".repeat(hashes));
            let open = i + 2 + hashes;
            let end = (open..chars.len()).find(|&k| starts(k, &close)).map_or(chars.len(), |k| k + 1 + hashes);
            out.push_str("\"\"");
            i = skip(&mut out, i, end);
        } else if at(i) == '"' {
            let mut end = i + 1;
            while end < chars.len() && at(end) != '"' {
                end += if at(end) == '\\' { 2 } else { 1 };
            }
            out.push_str("\"\"");
            i = skip(&mut out, i, end + 1);
        } else if at(i) == '\'' && (at(i + 1) == '\\' || at(i + 2) == '\'') {
            let first_end = if at(i + 1) == '\\' { i + 4 } else { i + 3 };
            i = (first_end..=chars.len()).find(|&k| at(k - 1) == '\'').unwrap_or(chars.len());
            out.push_str("' '");
        } else {
            out.push(at(i));
            i += 1;
        }
    }
    out
}

/// The code without the items behind `#[cfg(test)]`; line ends stay.
fn without_tests(code: &str) -> String {
    let mut out = String::with_capacity(code.len());
    let mut rest = code;
    while let Some(start) = rest.find("#[cfg(test)]") {
        out.push_str(&rest[..start]);
        let item = &rest[start..];
        let mut depth = 0;
        let mut end = item.len();
        for (k, c) in item.char_indices() {
            depth += i32::from(c == '{') - i32::from(c == '}');
            if depth == 0 && (c == '}' || c == ';') {
                end = k + 1;
                break;
            }
        }
        out.extend(item[..end].chars().filter(|&c| c == '\n'));
        rest = &item[end..];
    }
    out + rest
}

/// The first segments of the `crate::` paths in the code, with their lines.
fn crate_paths(code: &str) -> Vec<(usize, String)> {
    let ident = |text: &str| text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let mut found = Vec::new();
    for (start, _) in code.match_indices("crate::") {
        let line = code[..start].matches('\n').count() + 1;
        let rest = code[start + "crate::".len()..].trim_start();
        let Some(group) = rest.strip_prefix('{') else {
            found.push((line, ident(rest)));
            continue;
        };
        let mut depth = 0;
        let mut expects_name = true;
        for (k, c) in group.char_indices() {
            if expects_name && depth == 0 && !c.is_whitespace() && c != '}' {
                found.push((line, ident(&group[k..])));
                expects_name = false;
            }
            depth += i32::from(c == '{') - i32::from(c == '}');
            if depth < 0 {
                break;
            }
            expects_name |= depth == 0 && c == ',';
        }
    }
    found
}

fn floor(room: &str) -> Option<usize> {
    FLOORS.iter().position(|rooms| rooms.contains(&room))
}

/// Whether files of `room` may import from `other`.
fn may_import(room: &str, other: &str) -> bool {
    let stage = |name: &str| STAGES.iter().position(|s| *s == name);
    match (floor(room), floor(other)) {
        _ if room == other => true,
        // error wraps every room's errors, lib declares every room
        _ if room == "error" || room == "lib" => true,
        (Some(a), Some(b)) if a == b => (a == 0 && room != "schema") || stage(room) > stage(other),
        (Some(a), Some(b)) => a > b,
        _ => false,
    }
}

fn import_faults(sources: &[Source]) -> Vec<String> {
    let mut faults = Vec::new();
    for source in sources {
        let room = source.room();
        if floor(room).is_none() {
            faults.push(format!(
                "src/{}: room {room} has no floor: add it to FLOORS and to ARCHITECTURE.md",
                source.path
            ));
        }
        for (line, name) in crate_paths(&source.code) {
            // `crate::Error` is re-exported at the root
            let other = if name == "Error" { "error" } else { name.as_str() };
            if !may_import(room, other) {
                let path = &source.path;
                faults.push(format!(
                    "src/{path}:{line}: {room} must not import crate::{name}: only rooms on floors below"
                ));
            }
        }
    }
    faults
}

/// Lines on which the code names the crate `name` as the first segment of a path, or in `use name`.
fn crate_uses(code: &str, name: &str) -> Vec<usize> {
    let mut lines = Vec::new();
    for (start, _) in code.match_indices(name) {
        let (before, after) = (&code[..start], &code[start + name.len()..]);
        let own_path =
            before.strip_suffix("::").is_some_and(|b| b.ends_with(|c: char| c.is_alphanumeric() || c == '>'));
        let whole = !before.ends_with(|c: char| c.is_alphanumeric() || c == '_') && !own_path;
        let used = after.starts_with("::") || after.starts_with('!');
        if whole && (used || before.ends_with("use ")) {
            lines.push(before.matches('\n').count() + 1);
        }
    }
    lines
}

fn border_faults(sources: &[Source]) -> Vec<String> {
    let mut faults = Vec::new();
    for source in sources {
        let (room, path) = (source.room(), &source.path);
        for (names, rooms) in BORDERS {
            for name in names.iter().filter(|_| !rooms.contains(&room)) {
                for line in crate_uses(&source.code, name) {
                    faults.push(format!("src/{path}:{line}: {name} belongs to {} alone", rooms.join(", ")));
                }
            }
        }
        let polars = crate_uses(&source.code, "polars");
        if room != "storage" && !polars.is_empty() && !crate_uses(&source.code, "arrow").is_empty() {
            faults.push(format!("src/{path}:{}: polars and arrow meet only in storage", polars[0]));
        }
        for (word, rooms, remedy) in FORBIDDEN {
            for (start, _) in source.code.match_indices(word).filter(|_| !rooms.contains(&room)) {
                if *word == "println!" && source.code[..start].ends_with('e') {
                    continue;
                }
                let line = source.code[..start].matches('\n').count() + 1;
                faults.push(format!("src/{path}:{line}: {word} outside tests: {remedy}"));
            }
        }
    }
    faults
}

/// The `# …` lines of the documentation a file begins with.
fn headings(text: &str) -> Vec<&str> {
    let doc = text.lines().take_while(|line| line.starts_with("//!"));
    doc.filter_map(|line| line.strip_prefix("//! ")).filter(|line| line.starts_with("# ")).map(str::trim_end).collect()
}

fn plugin_faults(sources: &[Source]) -> Vec<String> {
    let mut faults = Vec::new();
    for room in PLUGIN_ROOMS {
        let files: Vec<&Source> = sources.iter().filter(|s| s.room() == *room).collect();
        let Some(list) = files.iter().find(|s| s.path == format!("{room}/mod.rs")) else { continue };
        let listed: Vec<String> = list
            .code
            .match_indices("::ENTRY")
            .map(|(end, _)| {
                let before = &list.code[..end];
                let name = before.rfind(|c: char| !(c.is_alphanumeric() || c == '_')).map_or(0, |k| k + 1);
                before[name..].to_owned()
            })
            .collect();
        let plugins: Vec<&&Source> = files.iter().filter(|s| s.code.contains("const ENTRY:")).collect();
        for plugin in &plugins {
            let (path, module) = (&plugin.path, plugin.module());
            if !listed.iter().any(|name| name == module) {
                faults
                    .push(format!("src/{path}: not listed: add `{module}::ENTRY,` to the slice in src/{room}/mod.rs"));
            }
            let found = headings(&plugin.text);
            if found != HEADINGS {
                let wanted = HEADINGS.join("\n  //! ");
                faults
                    .push(format!("src/{path}: begin with exactly these headings:\n  //! {wanted}\n  found {found:?}"));
            }
        }
        for name in listed.iter().filter(|name| !plugins.iter().any(|p| p.module() == **name)) {
            faults.push(format!(
                "src/{room}/mod.rs: lists {name}::ENTRY, but src/{room}/{name}.rs has no `const ENTRY:`"
            ));
        }
    }
    faults
}

fn assert_none(faults: &[String]) {
    assert!(faults.is_empty(), "the house is broken (see ARCHITECTURE.md):\n{}", faults.join("\n"));
}

#[test]
fn rooms_import_only_from_floors_below() {
    assert_none(&import_faults(&sources()));
}

#[test]
fn crates_and_words_stay_in_their_rooms() {
    assert_none(&border_faults(&sources()));
}

#[test]
fn plugin_files_are_listed_and_begin_alike() {
    assert_none(&plugin_faults(&sources()));
}

#[test]
fn no_file_is_too_long() {
    let mut sizes: Vec<(usize, String)> = sources().into_iter().map(|s| (s.text.lines().count(), s.path)).collect();
    sizes.sort_by(|a, b| b.cmp(a));
    println!("{} files, median {} lines; the longest:", sizes.len(), sizes[sizes.len() / 2].0);
    sizes.iter().take(10).for_each(|(lines, path)| println!("{lines:5} src/{path}"));
    let long: Vec<String> = sizes
        .iter()
        .filter(|(lines, _)| *lines > LONGEST_FILE)
        .map(|(lines, path)| format!("src/{path}: {lines} lines, more than {LONGEST_FILE}: split it by what it does"))
        .collect();
    assert_none(&long);
}

#[test]
fn the_scanner_sees_wrong_imports_and_only_those() {
    let wrong = [
        Source::new("link/dropout.rs", "use crate::scenario::World;\nuse crate::rng::Seeds;\n"),
        Source::new("schema/mod.rs", "use crate::{\n    io::{self, IoError},\n};\n"),
        Source::new("record/mod.rs", "fn f() {\n    crate::mi::run();\n}\n"),
        Source::new("attic.rs", ""),
    ];
    let rule = "only rooms on floors below";
    assert_eq!(
        import_faults(&wrong),
        [
            format!("src/link/dropout.rs:1: link must not import crate::scenario: {rule}"),
            format!("src/schema/mod.rs:1: schema must not import crate::io: {rule}"),
            format!("src/record/mod.rs:2: record must not import crate::mi: {rule}"),
            "src/attic.rs: room attic has no floor: add it to FLOORS and to ARCHITECTURE.md".to_owned(),
        ]
    );
    let right = [
        Source::new("mi/mod.rs", "use crate::pairs::Pairs;\nuse crate::{Error, nn::{Adam, Mlp}, stats};\n"),
        Source::new(
            "io.rs",
            "use crate::schema::hex;\n/// [`crate::cli`]\n// crate::cli\nconst S: &str = \"crate::cli\";\n",
        ),
        Source::new("error.rs", "use crate::train::TrainError;\n"),
        Source::new("rng.rs", "#[cfg(test)]\nmod tests {\n    use crate::cli;\n    fn f() { if true {} }\n}\n"),
    ];
    assert_eq!(import_faults(&right), [""; 0]);
}

#[test]
fn the_scanner_sees_crates_and_words_out_of_place() {
    let wrong = [
        Source::new("report/mod.rs", "use plotters::prelude::*;\nlet x = y.unwrap();\n"),
        Source::new("train/mod.rs", "use ::mcap::Writer;\n#[allow(dead_code)]\nuse std::collections::HashMap;\n"),
        Source::new("pairs.rs", "eprintln!();\nuse polars::prelude::*;\nuse arrow::array::Array;\n"),
    ];
    assert_eq!(
        border_faults(&wrong),
        [
            "src/report/mod.rs:1: plotters belongs to figure alone",
            "src/report/mod.rs:2: .unwrap() outside tests: return a typed error",
            "src/train/mod.rs:1: mcap belongs to storage alone",
            "src/train/mod.rs:2: #[allow( outside tests: write #[expect(lint, reason = \"…\")]",
            "src/train/mod.rs:3: HashMap outside tests: its order is not fixed: use BTreeMap",
            "src/pairs.rs:2: polars and arrow meet only in storage",
            "src/pairs.rs:1: eprintln! outside tests: only cli prints: return an error",
        ]
    );
    let right = [
        Source::new("cli/list.rs", "println!(\"{}\", crate::storage::mcap::NAME);\n"),
        Source::new(
            "pairs.rs",
            "let p = format!(\"{x}.parquet\"); let c = ['\"', '\\'']; // mcap::read\nf(r#\"a \"plotters::b\"#);\n",
        ),
        Source::new("storage/mcap.rs", "use mcap::Writer;\n#[expect(lint, reason = \"x\")]\nfn f<'a>(x: &'a str) {}\n"),
    ];
    assert_eq!(border_faults(&right), [""; 0]);
}

#[test]
fn the_scanner_sees_unlisted_and_undocumented_plugins() {
    let doc = format!("//! {}\n//!\n//! Words.\n", HEADINGS.join("\n//!\n//! Words.\n//!\n//! "));
    let plugin = format!("{doc}\npub(super) const ENTRY: Entry<Build> = x;\n");
    let list = |code: &str| Source::new("link/mod.rs", code);
    let good = [list("const LINKS: &[Entry<Build>] = &[dropout::ENTRY];"), Source::new("link/dropout.rs", &plugin)];
    assert_eq!(plugin_faults(&good), [""; 0]);

    let unlisted = [list("const LINKS: &[Entry<Build>] = &[];"), Source::new("link/dropout.rs", &plugin)];
    let add = "src/link/dropout.rs: not listed: add `dropout::ENTRY,` to the slice in src/link/mod.rs";
    assert_eq!(plugin_faults(&unlisted), [add]);

    let swapped = plugin.replace("# Parameters", "# Options");
    let misnamed = [list("[dropout::ENTRY, markov::ENTRY]"), Source::new("link/dropout.rs", &swapped)];
    let faults = plugin_faults(&misnamed);
    assert_eq!(faults.len(), 2, "{faults:?}");
    assert!(faults[0].starts_with("src/link/dropout.rs: begin with exactly these headings:\n  //! # What it is\n"));
    assert_eq!(faults[1], "src/link/mod.rs: lists markov::ENTRY, but src/link/markov.rs has no `const ENTRY:`");
}
