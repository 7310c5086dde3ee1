// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fcntl.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <filesystem>
#include <sstream>
#include <string>
#include <vector>

namespace omnister::test {

/// Another program beside the test; killed at the end, also when the test dies.
class ChildProcess {
 public:
  /// @param output file that takes what it prints
  explicit ChildProcess(std::vector<std::string> command, const std::string& output = "/dev/null") {
    std::vector<char*> arguments;
    for (std::string& word : command) arguments.push_back(word.data());
    arguments.push_back(nullptr);
    // Before the fork, so that whoever looks into it at once finds it.
    const int printed = open(output.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    id_ = fork();
    if (id_ != 0) {
      close(printed);
      return;
    }
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    dup2(open("/dev/null", O_RDONLY), STDIN_FILENO);
    dup2(printed, STDOUT_FILENO);
    dup2(printed, STDERR_FILENO);
    execvp(arguments[0], arguments.data());
    _exit(127);
  }
  ~ChildProcess() { end(); }
  ChildProcess(const ChildProcess&) = delete;
  ChildProcess& operator=(const ChildProcess&) = delete;

  void signal(int number) const {
    if (id_ > 0) kill(id_, number);
  }
  /// Waits for its own end. @return exit status; -1 when a signal ended it
  int wait() {
    int status = 0;
    if (id_ <= 0 || waitpid(id_, &status, 0) != id_) return -1;
    id_ = -1;
    return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
  }
  void end() {
    if (id_ <= 0) return;
    kill(id_, SIGKILL);
    waitpid(id_, nullptr, 0);
    id_ = -1;
  }

  static bool installed(const std::string& program) {
    std::stringstream folders(getenv("PATH") ? getenv("PATH") : "");
    for (std::string folder; std::getline(folders, folder, ':');) {
      if (access((std::filesystem::path(folder) / program).c_str(), X_OK) == 0) return true;
    }
    return false;
  }

 private:
  pid_t id_ = -1;
};

}  // namespace omnister::test
