//! The one integration binary. `cfg(test)` tells clippy that helper functions are tests too: they may unwrap and print.
#![cfg(test)]

mod allocations;
mod architecture;
mod cli;
mod estimate_mi;
mod extracts;
mod figures;
mod fuzz;
mod integrity;
mod links;
mod mi;
mod record;
mod report;
mod rows;
mod stats;
mod stores;
mod train;
mod worlds;
