//! Figures: what a reader needs is on them, and nothing else gets in.

use ccmarl::figure::{Bar, Cell, Curve, Data, FIGURES, Pair, Point, Reference, Shrunk, Training, Whisker, svg};
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
        loss_by_distance: shares.clone(),
        mi_by_lag: shares,
        pair: Pair {
            names: ["wind".to_owned(), "power".to_owned()],
            levels: <[Vec<String>; 2]>::default(),
            points: (0..200).map(|i| (f64::from(i) * 0.01, f64::from(i * i % 173) * 0.02)).collect(),
            estimates: vec![
                Whisker { label: "gaussian".to_owned(), sign: "", value: 0.4133, band: Some((0.38, 0.45)) },
                Whisker { label: "infonce".to_owned(), sign: "≥ ", value: 0.3921, band: Some((0.35, 0.43)) },
            ],
            shrunk: Some(Shrunk {
                label: "gaussian".to_owned(),
                points: vec![(200.0, 0.41), (100.0, 0.42), (100.0, 0.43), (50.0, 0.46)],
                line: (0.39, 3.0),
            }),
            trainings: vec![Training {
                label: "infonce".to_owned(),
                score: "bound, nats".to_owned(),
                looks: (0..20).map(|k| (f64::from(25 * k), 0.02 * f64::from(k), 0.015 * f64::from(k))).collect(),
                chosen: 400.0,
            }],
        },
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
fn an_axis_of_words_has_the_words_where_an_axis_of_numbers_has_numbers() {
    let entry = FIGURES.iter().find(|entry| entry.name == "mi-pair").unwrap();
    let mut data = data();
    data.pair = Pair {
        names: ["size".to_owned(), "color".to_owned()],
        levels: [["small", "tall"].map(str::to_owned).to_vec(), (0..20).map(|i| format!("hue{i}")).collect()],
        points: (0..40).map(|i| (f64::from(i % 2), f64::from(i % 20))).collect(),
        ..Pair::default()
    };
    let text = svg(entry, &data).unwrap();
    let has = |word: &str| text.contains(&format!("\n{word}\n"));
    assert!(["small", "tall", "hue0", "hue3", "hue18"].into_iter().all(has), "{text}");
    assert!(!has("hue1") && !has("0.5") && !has("10"), "{text}");
    data.pair.levels = <[Vec<String>; 2]>::default();
    let text = svg(entry, &data).unwrap();
    assert!(text.contains("\n0.5\n") && text.contains("\n10\n"), "{text}");
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

#[test]
fn a_pair_shows_names_values_sizes_and_what_the_lines_are() {
    let text = svg(find("figure", FIGURES, "mi-pair").unwrap(), &data()).unwrap();
    let shown = ["wind", "power", "200 points", "≥ 0.3921", "0.4133", "∞", "50", "200", "training", "validation"];
    for words in [&shown[..], &["gaussian by number of samples", "training of infonce", "bound, nats"]].concat() {
        assert!(text.contains(&format!("\n{words}\n")), "{words}");
    }
    let mut without = data();
    (without.pair.shrunk, without.pair.trainings) = (None, Vec::new());
    let text = svg(find("figure", FIGURES, "mi-pair").unwrap(), &without).unwrap();
    assert!(text.contains("viewBox=\"0 0 1600 772\"") && !text.contains("training"), "one row of panels");
    without.pair.estimates[1].value = f64::NAN;
    let error = svg(find("figure", FIGURES, "mi-pair").unwrap(), &without).unwrap_err().to_string();
    assert_eq!(error, "figure mi-pair: the estimate \"infonce\" is NaN: only finite numbers can be drawn");
}

#[test]
fn an_interval_below_zero_stays_on_the_axis() {
    let mut data = data();
    data.mi_by_lag[0].points[0].band = Some((-0.5, 0.3));
    let text = svg(find("figure", FIGURES, "mi-by-lag").unwrap(), &data).unwrap();
    assert!(text.contains("\n−0.4\n"), "{text}");
}
