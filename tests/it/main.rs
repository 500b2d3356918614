//! The one integration binary.

mod architecture;
mod cli;
mod links;
mod record;
mod worlds;
