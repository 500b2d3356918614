//! The one integration binary.

mod figures;
mod links;
mod record;
mod report;
mod stats;
mod worlds;
