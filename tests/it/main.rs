//! The one integration binary.

mod links;
mod record;
mod train;
mod worlds;
