//! Tables as Markdown and CSV text.

use crate::report::returns::{Returns, Tidy};

/// A table as rows of text: what Markdown and the page both show.
pub(super) struct Grid {
    /// Column names.
    pub header: Vec<String>,
    /// Lines; each cell with whether it is set in bold.
    pub lines: Vec<Line>,
}

/// One line of a [`Grid`].
pub(super) struct Line {
    /// `ours`, `published`, `difference` or `reference`.
    pub kind: &'static str,
    /// Cells: text, and whether in bold.
    pub cells: Vec<(String, bool)>,
}

fn plain(text: impl Into<String>) -> (String, bool) {
    (text.into(), false)
}

/// The returns table, three lines per algorithm that has published cells (ours, published, difference).
pub(super) fn grid(returns: &Returns) -> Grid {
    let mut header = vec!["algorithm".to_owned(), "what".to_owned(), "seeds".to_owned()];
    header.extend(returns.channels.iter().cloned());
    let mut lines = Vec::new();
    for row in &returns.rows {
        let mut ours = vec![plain(&row.series), plain("ours"), plain(row.seeds.len().to_string())];
        let mut published = vec![plain(""), plain("published"), plain("1")];
        let mut difference = vec![plain(""), plain("ours − published"), plain("")];
        for cell in &row.cells {
            let Some(cell) = cell else {
                for line in [&mut ours, &mut published, &mut difference] {
                    line.push(plain("–"));
                }
                continue;
            };
            let seeds = cell.seeds_label(row);
            ours.push((format!("{:.1} ± {:.1}{seeds}", cell.mean, cell.spread()), cell.best));
            published.push(plain(cell.published.map_or("–".to_owned(), |p| format!("{:.1} ± {:.1}", p.mean, p.sd))));
            difference.push(plain(cell.published.map_or("–".to_owned(), |p| format!("{:+.1}", cell.mean - p.mean))));
        }
        lines.push(Line { kind: "ours", cells: ours });
        if row.cells.iter().flatten().any(|c| c.published.is_some()) {
            lines.push(Line { kind: "published", cells: published });
            lines.push(Line { kind: "difference", cells: difference });
        }
    }
    for &(name, mean, sd, _) in &returns.references {
        let mut cells = vec![plain(name), plain("reference"), plain("")];
        cells.extend(returns.channels.iter().map(|_| plain(format!("{mean:.1} ± {sd:.1}"))));
        lines.push(Line { kind: "reference", cells });
    }
    let mut losses = vec![plain("messages lost"), plain("realised"), plain("")];
    for column in 0..returns.channels.len() {
        let cells: Vec<f64> =
            returns.rows.iter().filter_map(|r| r.cells[column].as_ref()).map(|c| c.loss_rate).collect();
        let mean = format!("{:.1} %", 100.0 * crate::stats::mean(&cells));
        losses.push(plain(if returns.mixed == Some(column) { "by row".to_owned() } else { mean }));
    }
    lines.push(Line { kind: "loss", cells: losses });
    Grid { header, lines }
}

/// The caption: what is counted, of which episodes.
pub(super) fn caption(returns: &Returns) -> String {
    format!("Return per test episode on {}. Reward: {}.", returns.task, returns.convention.trim_end_matches('.'))
}

/// A Markdown document of the table with its caption and notes.
pub(super) fn document(returns: &Returns) -> String {
    let mut text = format!("{}\n\n", escape(&caption(returns)));
    let grid = grid(returns);
    text.push_str(&table(&grid));
    text.push('\n');
    for note in &returns.notes {
        text.extend(["- ", &escape(note), "\n"]);
    }
    text
}

/// The grid as a Markdown table; numbers to the right.
pub(super) fn table(grid: &Grid) -> String {
    let mut text = format!("| {} |\n", grid.header.iter().map(|h| escape(h)).collect::<Vec<_>>().join(" | "));
    let rule: Vec<&str> = (0..grid.header.len()).map(|i| if i < 2 { "---" } else { "---:" }).collect();
    text.extend(["| ", &rule.join(" | "), " |\n"]);
    for line in &grid.lines {
        let cells: Vec<String> = line
            .cells
            .iter()
            .map(|(cell, bold)| if *bold { format!("**{}**", escape(cell)) } else { escape(cell) })
            .collect();
        text.extend(["| ", &cells.join(" | "), " |\n"]);
    }
    text
}

/// Text that cannot break a Markdown table or become markup.
pub(super) fn escape(text: &str) -> String {
    let mut out = String::new();
    for c in crate::io::printable(text).chars() {
        match c {
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '|' | '*' | '`' | '[' | ']' | '\\' => out.extend(['\\', c]),
            _ => out.push(c),
        }
    }
    out
}

/// A CSV of rows of text with a header, RFC 4180 quoting.
pub(super) fn csv(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let quote = |field: &str| {
        if field.contains([',', '"', '\n', '\r']) {
            format!("\"{}\"", field.replace('"', "\"\""))
        } else {
            field.to_owned()
        }
    };
    let mut text = format!("{}\n", header.join(","));
    for row in rows {
        text.push_str(&row.iter().map(|f| quote(f)).collect::<Vec<_>>().join(","));
        text.push('\n');
    }
    text
}

/// The tidy lines as CSV; numbers with six significant decimals, empty where there is none.
pub(super) fn tidy_csv(lines: &[Tidy]) -> String {
    const HEADER: [&str; 17] = [
        "scenario",
        "profile",
        "agents",
        "channel",
        "algorithm",
        "seeds",
        "episodes",
        "mean",
        "sd_over_episodes",
        "interval_low",
        "interval_high",
        "loss_rate",
        "published_mean",
        "published_sd",
        "published_table",
        "difference",
        "best",
    ];
    let number = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.6}"));
    let row = |t: &Tidy| {
        vec![
            t.scenario.clone(),
            t.profile.clone(),
            t.agents.to_string(),
            t.channel.clone(),
            t.algorithm.clone(),
            t.seeds.to_string(),
            t.episodes.to_string(),
            number(Some(t.mean)),
            number(Some(t.sd_over_episodes)),
            number(t.interval_low),
            number(t.interval_high),
            number(t.loss_rate),
            number(t.published_mean),
            number(t.published_sd),
            t.published_table.unwrap_or_default().to_owned(),
            number(t.difference),
            t.best.to_string(),
        ]
    };
    csv(&HEADER, lines.iter().map(row))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_text_stays_text() {
        assert_eq!(escape("a|b<script>*x*\n"), "a\\|b&lt;script&gt;\\*x\\*\\\\n");
        assert_eq!(
            csv(&["a", "b"], std::iter::once(vec!["x,\"y\"".to_owned(), "z".to_owned()])),
            "a,b\n\"x,\"\"y\"\"\",z\n"
        );
    }
}
