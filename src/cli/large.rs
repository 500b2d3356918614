//! Tables that memory does not hold: some estimators read all rows once, all others get a random sample.

use std::io::IsTerminal as _;
use std::path::PathBuf;
use std::time::Instant;

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

/// Reads the table once, for the estimators that can do with that. The others, or a picture, get `options.sample`.
pub(super) fn read(paths: &[PathBuf], mut options: TableOptions, plan: Plan, picture: bool) -> Result<Input, Error> {
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
        passes.par_iter_mut().for_each(|pass| pass.add(piece));
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
    })?;
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

impl Pass {
    fn add(&mut self, piece: &Samples) {
        let Ok(made) = &mut self.made else { return };
        if let Err(error) = mi::fits(piece, &*self.named.1).and_then(|()| made.add(piece)) {
            self.made = Err(error);
        }
    }
}
