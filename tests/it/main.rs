//! The one integration binary. `cfg(test)` tells clippy that helper functions are tests too: they may unwrap and print.
#![cfg(test)]

mod architecture;
mod cli;
mod links;
mod record;
mod worlds;
