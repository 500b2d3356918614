//! Paired samples: what an estimator sees, whether they came from a store or from a table.

use std::sync::Arc;

/// What a note begins with that is no warning.
pub const NOTE: &str = "note: ";

/// A row-major `f64` matrix with named columns.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Columns {
    /// Elements, row by row.
    pub data: Vec<f64>,
    /// One name per column; their number is the width.
    pub names: Vec<String>,
    /// Per column, whether it holds words: numbers that stand for categories, whose size means nothing. Empty: none does.
    pub words: Vec<bool>,
    /// Per column, the words that its numbers stand for, in order, if they are few and known. Empty: of none.
    pub levels: Vec<Vec<String>>,
}

impl Columns {
    /// Columns of numbers.
    pub fn new(data: Vec<f64>, names: Vec<String>) -> Self {
        Self { data, names, ..Self::default() }
    }

    /// The same columns without a row.
    #[must_use]
    pub fn without_rows(&self) -> Self {
        let Self { names, words, levels, .. } = self;
        Self { data: Vec::new(), names: names.clone(), words: words.clone(), levels: levels.clone() }
    }

    /// The words of column `c`, if they are few and known.
    pub fn levels(&self, c: usize) -> &[String] {
        self.levels.get(c).map_or(&[], Vec::as_slice)
    }

    /// Whether column `c` holds words.
    pub fn is_words(&self, c: usize) -> bool {
        self.words.get(c) == Some(&true)
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.names.len()
    }

    /// Rows.
    pub fn rows(&self) -> usize {
        self.data.len().checked_div(self.width()).unwrap_or(0)
    }

    /// Row `r`, `[width]`.
    pub fn row(&self, r: usize) -> &[f64] {
        &self.data[r * self.width()..(r + 1) * self.width()]
    }
}

/// What is exchangeable when x and y have nothing to do with each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exchange {
    /// Whole episodes.
    Episodes,
    /// Nothing but the start: one series, which may be shifted in a circle.
    Shift,
}

/// What a set of samples is called in results.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SampleLabels {
    /// Columns of x, as the user knows them: `message.agent_0`, or `a,b`.
    pub x: String,
    /// Columns of y.
    pub y: String,
    /// Columns of z, if any.
    pub given: Option<String>,
    /// Who sent.
    pub sender: Option<String>,
    /// Who received.
    pub receiver: Option<String>,
    /// Whether the messages arrived.
    pub delivered: Option<bool>,
    /// What one episode is: `episode` of a store, a column's name, `blocks of <time>`, or `row`; behind a comma, which
    /// part of the data the samples are, if they are one.
    pub group: String,
    /// That part: `species = setosa`, `steps 0–9`.
    pub within: Option<String>,
}

/// Samples of (x, y) in episodes. The columns also hold the rows between the samples (messages of the other class),
/// since a null test permutes whole trajectories of x before it picks rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Samples {
    /// x, all rows of all episodes.
    pub x: Arc<Columns>,
    /// y, the same rows.
    pub y: Arc<Columns>,
    /// z, the same rows, if any.
    pub z: Option<Arc<Columns>>,
    /// Episode e is rows `starts[e]..starts[e + 1]`, in order of time; none is empty.
    pub starts: Arc<[usize]>,
    /// The rows that are samples, ascending.
    pub rows: Vec<u32>,
    /// What the null test may exchange.
    pub exchange: Exchange,
    /// Names.
    pub labels: SampleLabels,
    /// What a reader of the result must know: rows dropped, rows taken as episodes.
    pub notes: Vec<String>,
}

impl Samples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Episode of each sample, ascending.
    pub fn episodes(&self) -> Vec<u32> {
        let mut episode = 0;
        let of = |&row: &u32| {
            while episode + 2 < self.starts.len() && self.starts[episode + 1] <= row as usize {
                episode += 1;
            }
            episode as u32
        };
        self.rows.iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_know_their_episodes() {
        let columns = Arc::new(Columns::new(vec![0.0; 6], vec!["a".to_owned()]));
        let samples = Samples {
            x: Arc::clone(&columns),
            y: columns,
            z: None,
            starts: Arc::from([0, 2, 3, 6]),
            rows: vec![1, 3, 4, 5],
            exchange: Exchange::Episodes,
            labels: SampleLabels::default(),
            notes: Vec::new(),
        };
        assert_eq!(samples.episodes(), [0, 2, 2, 2]);
        assert_eq!((samples.len(), samples.x.rows()), (4, 6));
    }
}
