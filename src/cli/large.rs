//! Tables that memory does not hold: some estimators read all rows once, all others get a random sample.

use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use rayon::prelude::*;

use super::{jobs, ui};
use crate::Error;
use crate::mi::{self, Job, JobResult, MiError, OnePass, Plan};
use crate::pairs::{self, PieceSize, TableOptions};
use crate::schema::Samples;

/// Rows of the sample, unless the user gives another number.
pub(super) const SAMPLE: usize = 1_000_000;

/// What there is to run, and what is finished already.
pub(super) struct Input {
    pub(super) samples: Vec<Samples>,
    pub(super) plan: Plan,
    /// Places of the plan's estimators among all that were asked for; none: the same.
    pub(super) places: Option<Vec<usize>>,
    pub(super) results: Vec<(usize, JobResult)>,
}

/// An estimate in the making, or why there is none.
struct Pass {
    place: usize,
    named: mi::Named,
    made: Result<Box<dyn OnePass>, MiError>,
}

/// Reads the table once, for the estimators that can do with that, on so many threads (0: one per core). The others, or a
/// picture, get `options.sample`.
pub(super) fn read(
    paths: &[PathBuf],
    mut options: TableOptions,
    plan: Plan,
    picture: bool,
    threads: u16,
) -> anyhow::Result<Input> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build();
    let pool = pool.context("could not start threads")?;
    let (mut passes, mut rest, mut places) = (Vec::new(), Vec::new(), Vec::new());
    for (place, named) in plan.estimators.into_iter().enumerate() {
        if let Some(made) = named.1.one_pass() {
            passes.push(Pass { place, named, made: Ok(made) });
        } else {
            rest.push(named);
            places.push(place);
        }
    }
    if rest.is_empty() && !picture {
        options.sample = None;
    }
    let bar = ui::progress(0, "reading rows");
    let (plain, started, mut said) = (!std::io::stderr().is_terminal(), Instant::now(), Instant::now());
    let passed = pairs::pass(paths, &options, PieceSize::default(), &mut |piece, progress| {
        let more = add(&pool, &mut passes, piece);
        bar.set_length(progress.of.unwrap_or(progress.rows));
        bar.set_position(progress.rows);
        if plain && said.elapsed() >= jobs::LINE_EVERY {
            let (rows, of) = (progress.rows as usize, progress.of.map(|of| of as usize));
            ui::say(&of.map_or_else(
                || format!("reading rows: {rows}"),
                |of| jobs::line("reading rows", rows, of, started.elapsed()),
            ));
            said = Instant::now();
        }
        more
    });
    let passed = passed.map_err(Error::from)?;
    bar.finish_and_clear();
    let labels = &passed.sample.labels;
    let result = |pass: Pass| {
        let rows = pass.made.and_then(|made| made.finish(labels, &passed.notes));
        (pass.place, JobResult { job: Job { estimator: pass.named.0, labels: labels.clone() }, rows })
    };
    Ok(Input {
        results: passes.into_iter().map(result).collect(),
        plan: Plan { estimators: rest, protocol: plan.protocol, seed: plan.seed },
        places: Some(places),
        samples: vec![passed.sample],
    })
}

/// Gives a piece to all passes, on the threads of a pool; whether any of them wants more.
fn add(pool: &rayon::ThreadPool, passes: &mut [Pass], piece: &Samples) -> bool {
    pool.install(|| passes.par_iter_mut().for_each(|pass| pass.add(piece)));
    passes.iter().any(|pass| pass.made.is_ok())
}

impl Pass {
    fn add(&mut self, piece: &Samples) {
        let Ok(made) = &mut self.made else { return };
        if let Err(error) = mi::fits(piece, &*self.named.1).and_then(|()| made.add(piece)) {
            self.made = Err(error);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mi::{ESTIMATORS, Estimate};
    use crate::registry::{Spec, find};
    use crate::schema::{Columns, Exchange, SampleLabels};

    /// Takes so many pieces, as long as it is on a pool of two threads.
    struct Counting(usize);

    impl OnePass for Counting {
        fn add(&mut self, _: &Samples) -> Result<(), MiError> {
            let left = self.0.checked_sub(1).filter(|_| rayon::current_num_threads() == 2);
            self.0 = left.ok_or(MiError::TooFewSamples { needed: 1, widths: 2, found: 0 })?;
            Ok(())
        }

        fn finish(&self, _: &SampleLabels, _: &[String]) -> Result<Vec<Estimate>, MiError> {
            Ok(Vec::new())
        }
    }

    #[test]
    fn passes_run_on_the_threads_asked_for_until_none_wants_more() {
        let column = Arc::new(Columns::new(vec![1.0, 2.0], vec!["a".to_owned()]));
        let piece = Samples {
            x: Arc::clone(&column),
            y: column,
            z: None,
            starts: vec![0, 1, 2].into(),
            rows: vec![0, 1],
            exchange: Exchange::Episodes,
            labels: SampleLabels::default(),
            notes: Vec::new(),
        };
        let spec = Spec::new("gaussian");
        let pass = |place, pieces| {
            let estimator = (find("estimator", ESTIMATORS, "gaussian").unwrap().build)(&spec).unwrap();
            Pass { place, named: (spec.to_string(), estimator), made: Ok(Box::new(Counting(pieces))) }
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let mut passes = [pass(0, 1), pass(1, 2)];
        assert_eq!([0; 3].map(|_| add(&pool, &mut passes, &piece)), [true, true, false]);
    }
}
