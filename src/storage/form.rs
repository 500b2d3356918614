//! Which form anybody's table has: CSV, TSV or Parquet.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use crate::io::IoError;

/// `Parquet`, `TSV` or `CSV`, by the first bytes, else by the ending of the name.
///
/// # Errors
/// [`IoError::Os`].
pub fn table_form(path: &Path) -> Result<&'static str, IoError> {
    let mut magic = Vec::new();
    let file = File::open(path).map_err(IoError::os("open", path))?;
    file.take(4).read_to_end(&mut magic).map_err(IoError::os("read", path))?;
    let named = |extension: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension));
    Ok(if named("parquet") || magic == b"PAR1" {
        "Parquet"
    } else if named("tsv") || named("tab") {
        "TSV"
    } else {
        "CSV"
    })
}
