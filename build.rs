//! Compiles the .proto files of the MCAP store: Rust messages, and the descriptor sets that go into each file.
#![expect(clippy::disallowed_methods, reason = "OUT_DIR is cargo's own")]

use std::path::PathBuf;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = "src/schema/proto";
    println!("cargo::rerun-if-changed={folder}");
    if std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "linux") {
        // the symbol table is a fifth of the binary
        println!("cargo::rustc-link-arg-bins=-Wl,--strip-all");
    }
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("OUT_DIR is not set")?);
    for name in ["rollout", "viewer"] {
        let mut compiler = protox::Compiler::new([folder])?;
        // Without source info the bytes depend on the messages alone, not on their comments.
        compiler.include_source_info(false).include_imports(true).open_file(format!("{name}.proto"))?;
        std::fs::write(out.join(format!("{name}.binpb")), compiler.encode_file_descriptor_set())?;
        let mut config = prost_build::Config::new();
        config.skip_protoc_run().compile_well_known_types();
        config.compile_fds(compiler.file_descriptor_set())?;
    }
    Ok(())
}
