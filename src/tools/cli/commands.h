// SPDX-License-Identifier: Apache-2.0
/// @file The subcommands. Each adds itself to the application with a callback that does the work
/// and throws Error where a person can mend something.
#pragma once

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/progress.h"

namespace omnister::tools {

/// Adds `--json` to a subcommand. @return where the flag is stored; lives as long as the
/// application
bool& addJsonFlag(CLI::App& command);

/// The result of a subcommand: one JSON object on standard output with --json, else one "key:
/// value" line each.
void printResult(bool json, const nlohmann::ordered_json& result);

/// A JSON text, also where a string is no UTF-8, as names of files and frames need not be: what is
/// not stands there as U+FFFD.
std::string jsonText(const nlohmann::ordered_json& value, int indent = -1);

/// A remark for a person, on standard error.
void say(const std::string& message);

/// Progress on standard error with percentage and time left: rewrites one line on a terminal, else
/// a line every two seconds, and none for what is over sooner.
Progress consoleProgress();

/// To be called before any work: no output may be an input or another output (links followed), a
/// folder, or lie in a folder that is not there. Empty names are passed over. @throws InputError
void checkOutputs(const std::vector<std::string>& inputs, const std::vector<std::string>& outputs);

/// "1280x960". @throws CLI::ValidationError (wrong usage)
struct Size {
  int width = 0;
  int height = 0;
};
bool lexical_cast(const std::string& text, Size& size);

/// What `work` gives. An error that names no file names `source`, which it is about.
template <typename Work>
auto namingSource(const std::string& source, const Work& work) {
  try {
    return work();
  } catch (const InputError&) {
    throw;
  } catch (const IoError&) {
    throw;
  } catch (const Error& error) {
    throw InputError(source, "", error.what());
  }
}

/// Every subcommand has one of these, in the file of its name.
using AddCommand = void (*)(CLI::App& app);

}  // namespace omnister::tools
