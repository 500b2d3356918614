//! The one integration binary. `cfg(test)` tells clippy that helper functions are tests too: they may unwrap and print.
#![cfg(test)]

mod allocations;
mod architecture;
mod channel;
mod cli;
mod encoder;
mod estimate_mi;
mod extracts;
mod figures;
mod forged;
mod fuzz;
mod integrity;
mod learner;
mod link_commands;
mod links;
mod mi;
mod probe;
mod probe_stores;
mod record;
mod recovery;
mod refusals;
mod report;
mod rows;
mod shaping;
mod signals;
mod stats;
mod stores;
mod table_forms;
mod table_input;
mod table_lags;
mod train;
mod train_runs;
mod worlds;
