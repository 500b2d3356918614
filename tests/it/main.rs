//! The one integration binary.

mod links;
mod record;
mod stores;
mod train;
mod worlds;
