// What roscpp's XML-RPC library makes of an answer, and how it writes a call.
//
// Standard input: documents, each with its size in bytes on a line in front. An answer (<methodResponse>) is
// parsed as roscpp's client does. Standard output, for each: the size and the body of a call of the method
// "echo" (or "fault", or "unreadable") whose parameter is the value that was parsed.

#include <iostream>
#include <string>

#include <xmlrpcpp/XmlRpc.h>

class Peer : public XmlRpc::XmlRpcClient
{
public:
  Peer() : XmlRpcClient("localhost", 1) {}

  std::string answer(std::string const& document)
  {
    _response = document;
    _isFault = false;
    XmlRpc::XmlRpcValue value;
    bool const readable = parseResponse(value);
    XmlRpc::XmlRpcValue params;
    params[0] = readable ? value : XmlRpc::XmlRpcValue(std::string());
    generateRequest(!readable ? "unreadable" : isFault() ? "fault" : "echo", params);
    return _request.substr(_request.find("\r\n\r\n") + 4);
  }
};

int main()
{
  XmlRpc::setVerbosity(0);
  Peer peer;
  std::string line;
  while (std::getline(std::cin, line))
  {
    std::string document(std::stoul(line), '\0');
    std::cin.read(&document[0], document.size());
    std::string const body = peer.answer(document);
    std::cout << body.size() << "\n" << body << std::flush;
  }
}
