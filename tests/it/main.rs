//! The one integration binary.

mod architecture;
mod cli;
mod estimate_mi;
mod links;
mod mi;
mod record;
mod stores;
mod train;
mod worlds;
