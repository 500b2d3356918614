//! The one integration binary.

mod architecture;
mod cli;
mod estimate_mi;
mod figures;
mod links;
mod mi;
mod record;
mod report;
mod stats;
mod stores;
mod train;
mod worlds;
