//! Figures: what a reader needs is on them, and nothing else gets in.

use ccmarl::figure::{Bar, Cell, Curve, Data, FIGURES, Point, Reference, svg};
use ccmarl::registry::find;

fn data() -> Data {
    let series = ["fc-maddpg", "cc-maddpg"];
    let bar = |channel: &str, series: &str, value: f64| Bar {
        group: format!("{channel}\n8.0 % lost"),
        series: series.to_owned(),
        value,
        low: value - 20.0,
        high: value + 20.0,
    };
    let curve = |series: &str, end: f64| Curve {
        series: series.to_owned(),
        points: (0..50)
            .map(|k| {
                let step = f64::from(k) * 8000.0;
                let value = -220.0 + (end + 220.0) * (1.0 - (-step / 1e5).exp());
                Point { step, value, band: Some((value - 6.0, value + 6.0)) }
            })
            .collect(),
    };
    let cell = |panel: &str, from: usize, to: usize, value: f64| Cell {
        panel: panel.to_owned(),
        sender: format!("agent_{from}"),
        receiver: format!("agent_{to}"),
        value: if from == to { f64::NAN } else { value },
    };
    let mut cells = Vec::new();
    for (panel, base) in [("delivered", 0.38), ("lost", 0.01)] {
        for from in 0..3 {
            for to in 0..3 {
                cells.push(cell(panel, from, to, base * (1.0 + 0.3 * from as f64 - 0.2 * to as f64)));
            }
        }
    }
    let share = |series: &&str| Curve {
        series: (*series).to_owned(),
        points: (1..9).map(|k| f64::from(k) / 9.0).map(|x| Point { step: x, value: x * x, band: None }).collect(),
    };
    let shares: Vec<Curve> = series.iter().map(share).collect();
    Data {
        title: "Return by test channel on simple_spread, 3 agents".to_owned(),
        subtitle: "one seed: ± one standard deviation over episodes, not a comparison".to_owned(),
        unit: "return per episode".to_owned(),
        series: series.iter().map(|s| (*s).to_owned()).collect(),
        curves: vec![curve("fc-maddpg", -139.0), curve("cc-maddpg", -129.0)],
        costs: vec![Curve {
            series: series[0].to_owned(),
            points: [3.0, 100.0].map(|n| Point { step: n, value: n * n, band: None }).to_vec(),
        }],
        reliability: shares.clone(),
        loss_by_step: shares.clone(),
        bursts: shares.clone(),
        loss_by_distance: shares,
        bars: ["unrestricted", "mbc-light", "dbc-heavy", "none"]
            .iter()
            .flat_map(|c| [bar(c, "fc-maddpg", -139.0), bar(c, "cc-maddpg", -129.0)])
            .collect(),
        references: vec![
            Reference { label: "random policy −224.1".to_owned(), value: -224.1 },
            Reference { label: "oracle policy −70.3".to_owned(), value: -70.3 },
        ],
        cells,
        axes: <[String; 2]>::default(),
    }
}

#[test]
fn every_figure_names_its_unit_its_title_and_what_its_marks_are() {
    for entry in FIGURES {
        let text = svg(entry, &data()).unwrap();
        for words in [&data().title, &data().subtitle, &data().unit] {
            assert!(text.contains(words.as_str()), "{} lacks {words:?}", entry.name);
        }
        assert!(text.contains("font-family=\"sans-serif\""), "{}", entry.name);
    }
}

#[test]
fn the_legend_names_each_series_and_reference_once() {
    for name in ["learning-curves", "channel-returns"] {
        let text = svg(find("figure", FIGURES, name).unwrap(), &data()).unwrap();
        for words in ["fc-maddpg", "cc-maddpg", "random policy −224.1", "oracle policy −70.3"] {
            assert_eq!(text.matches(&format!("\n{words}\n")).count(), 1, "{name}: {words}");
        }
    }
}

#[test]
fn a_heat_map_prints_the_values_in_its_cells() {
    let text = svg(find("figure", FIGURES, "mi-heatmap").unwrap(), &data()).unwrap();
    for words in ["delivered", "lost", "0.304", "agent_2", "sender", "receiver"] {
        assert!(text.contains(&format!("\n{words}\n")), "{words}");
    }
}
