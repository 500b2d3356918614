//! Samples from stores and tables.
//!
//! [`links`] reads a store: one set of samples per ordered link and class, delivered and lost apart. [`table()`] reads
//! anybody's table, in any form of [`crate::storage::TableForm`]: one set from named columns, or [`all_pairs`] of them.
//! [`pass`] goes once over a table that memory does not hold; [`Known`] writes one of any size. [`Lagging`] moves y in time; [`By`] pools links and
//! divides episodes; a [`Predicate`] leaves rows out.

mod by;
mod dates;
mod error;
mod known;
mod lag;
mod paths;
mod predicate;
mod store;
mod table;

pub use by::By;
pub use error::PairsError;
pub use known::{Known, is_known};
pub use lag::Lagging;
pub use paths::matching;
pub use predicate::Predicate;
pub use store::{Links, links};
pub use table::{Passed, PieceSize, Progress, Sample, TableOptions, all_pairs, is_store, pass, size, table, tables};
