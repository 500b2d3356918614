//! The one integration binary.

mod links;
mod record;
mod stores;
mod worlds;
