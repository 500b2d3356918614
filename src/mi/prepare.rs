//! Samples made ready for a trained estimator: split by episode, standardised by the training part, `f32`.

use super::MiError;
use super::knn::Points;
use crate::rng::{self, Seeds};
use crate::schema::{Columns, Samples};

/// Fewest episodes that can be split: five to train, two to stop by, three to report.
pub(super) const LEAST_EPISODES: usize = 10;
const LEAST_SAMPLES: usize = 40;

/// Standardised rows and who may see them. Rows are numbered as in the samples' columns.
#[derive(Debug)]
pub(super) struct Prepared {
    /// `[all rows, x_width]`.
    pub(super) x: Vec<f32>,
    pub(super) x_width: usize,
    /// `[all rows, y_width]`.
    pub(super) y: Vec<f32>,
    pub(super) y_width: usize,
    pub(super) train: Vec<u32>,
    pub(super) validation: Vec<u32>,
    pub(super) test: Vec<u32>,
    /// Episode of each test row.
    pub(super) test_blocks: Vec<u32>,
    /// Episodes in the test part, ascending.
    pub(super) test_episodes: Vec<u32>,
    pub(super) warnings: Vec<String>,
}

/// Half of the episodes to train, a fifth to stop by, the rest to report.
pub(super) fn prepare(samples: &Samples, seeds: &Seeds) -> Result<Prepared, MiError> {
    let blocks = samples.episodes();
    let mut episodes = blocks.clone();
    episodes.dedup();
    if episodes.len() < LEAST_EPISODES {
        return Err(MiError::TooFewEpisodes { needed: LEAST_EPISODES, found: episodes.len() });
    }
    if samples.len() < LEAST_SAMPLES {
        let widths = samples.x.width() + samples.y.width();
        return Err(MiError::TooFewSamples { needed: LEAST_SAMPLES, widths, found: samples.len() });
    }
    let order = rng::permutation(&mut seeds.stream("split"), episodes.len());
    let (train_end, validation_end) = (episodes.len() / 2, episodes.len() * 7 / 10);
    let mut part = vec![2u8; samples.starts.len()];
    for (place, &e) in order.iter().enumerate() {
        part[episodes[e] as usize] = u8::from(place >= train_end) + u8::from(place >= validation_end);
    }
    let of = |which: u8| -> Vec<u32> {
        let inside = samples.rows.iter().zip(&blocks).filter(|&(_, &b)| part[b as usize] == which);
        inside.map(|(&row, _)| row).collect()
    };
    let (train, validation, test) = (of(0), of(1), of(2));
    let test_blocks: Vec<u32> = blocks.into_iter().filter(|&b| part[b as usize] == 2).collect();
    let mut test_episodes = test_blocks.clone();
    test_episodes.dedup();
    let mut warnings = samples.notes.clone();
    let (x, x_width) = standardise(&samples.x, &train, &samples.labels.x, &mut warnings)?;
    let (y, y_width) = standardise(&samples.y, &train, &samples.labels.y, &mut warnings)?;
    if test_episodes.len() < 20 {
        warnings.push(format!("few blocks: the interval rests on {} test episodes", test_episodes.len()));
    }
    Ok(Prepared { x, x_width, y, y_width, train, validation, test, test_blocks, test_episodes, warnings })
}

fn standardise(
    columns: &Columns,
    train: &[u32],
    label: &str,
    warnings: &mut Vec<String>,
) -> Result<(Vec<f32>, usize), MiError> {
    let scales = scales(columns, train, label, warnings)?;
    let rows = (0..columns.rows()).map(|r| columns.row(r));
    let data = rows.flat_map(|row| scales.iter().map(|s| s.of(row) as f32)).collect();
    Ok((data, scales.len()))
}

/// A column that varies, and how it is standardised.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scale {
    /// Which column.
    pub(super) column: usize,
    mean: f64,
    /// 1/standard deviation.
    factor: f64,
}

impl Scale {
    /// The column's standardised value in a row.
    pub(super) fn of(self, row: &[f64]) -> f64 {
        (row[self.column] - self.mean) * self.factor
    }
}

/// The columns that vary over `rows`; the others are named in `warnings`.
pub(super) fn scales(
    columns: &Columns,
    rows: &[u32],
    label: &str,
    warnings: &mut Vec<String>,
) -> Result<Vec<Scale>, MiError> {
    let n = rows.len() as f64;
    let (mut scales, mut constant) = (Vec::new(), Vec::new());
    for column in 0..columns.width() {
        let value = |&r: &u32| columns.data[r as usize * columns.width() + column];
        let mean = rows.iter().map(value).sum::<f64>() / n;
        let variance = rows.iter().map(|r| (value(r) - mean) * (value(r) - mean)).sum::<f64>() / n;
        if variance > 1e-24 * mean * mean && variance > 0.0 {
            scales.push(Scale { column, mean, factor: 1.0 / libm::sqrt(variance) });
        } else {
            constant.push(columns.names[column].as_str());
        }
    }
    if scales.is_empty() {
        return Err(MiError::Constant { column: label.to_owned() });
    }
    if !constant.is_empty() {
        warnings.push(format!("constant, left out: {}", some_of(&constant)));
    }
    Ok(scales)
}

/// How far apart different words are, in standard deviations of the other columns: farther than any of those.
const FAR: f64 = 1e9;

/// All rows in `f64`, standardised over `rows`; constant columns are left out, words are far apart.
pub(super) fn points(
    columns: &Columns,
    rows: &[u32],
    label: &str,
    warnings: &mut Vec<String>,
) -> Result<Points, MiError> {
    let scales = scales(columns, rows, label, warnings)?;
    let all = (0..columns.rows()).map(|r| columns.row(r));
    let value = |row: &[f64], s: &Scale| if columns.is_words(s.column) { FAR * row[s.column] } else { s.of(row) };
    let data = all.flat_map(|row| scales.iter().map(|s| value(row, s)).collect::<Vec<_>>()).collect();
    Ok(Points { data, width: scales.len() })
}

/// Up to three names, and how many more.
pub(super) fn some_of(names: &[&str]) -> String {
    let shown = names.iter().take(3).copied().collect::<Vec<_>>().join(", ");
    if names.len() > 3 { format!("{shown} and {} more", names.len() - 3) } else { shown }
}

/// Whether most values of every column are repeated.
pub(super) fn all_tied(columns: &Columns, rows: &[u32]) -> bool {
    (0..columns.width()).all(|c| {
        let mut values: Vec<f64> = rows.iter().map(|&r| columns.row(r as usize)[c]).collect();
        values.sort_unstable_by(f64::total_cmp);
        let alone = (0..values.len())
            .filter(|&i| (i == 0 || values[i - 1] != values[i]) && values.get(i + 1) != Some(&values[i]));
        alone.count() * 2 < values.len()
    })
}

/// Says when most values of every column of x, or of y, are repeated: densities do not describe such data.
pub(super) fn tied(samples: &Samples) -> Option<String> {
    let which: Vec<&str> = [(&samples.x, &samples.labels.x), (&samples.y, &samples.labels.y)]
        .into_iter()
        .filter(|(columns, _)| all_tied(columns, &samples.rows))
        .map(|(_, label)| label.as_str())
        .collect();
    (!which.is_empty()).then(|| {
        let which = which.join(" and of ");
        format!("tied: most values of {which} occur more than once; ksg-mixed and discrete are made for such")
    })
}

/// Rows of a flat `[rows, width]` matrix, copied together.
pub(super) fn gather(data: &[f32], width: usize, rows: &[u32], out: &mut Vec<f32>) {
    out.clear();
    for &r in rows {
        out.extend_from_slice(&data[r as usize * width..(r as usize + 1) * width]);
    }
}
