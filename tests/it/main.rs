//! The one integration binary.

mod architecture;
mod cli;
mod estimate_mi;
mod mi;
mod stores;
